// What was on the wires at a time, from what the run was watched at.

import type { Shown, Values } from "./diagram";
import { unpack, type Part, type Run } from "./model";
import { before, short } from "./numbers";

const { textWidth } = window.flowgraph.dom;

interface Wire { at: Float32Array; values: Float32Array; parts: Part[]; size: number }

function partLine(part: Part, values: Float32Array): string {
  const unit = part.unit ? ` ${part.unit}` : "";
  const numbers = Array.from(values, (x) => short(x));
  if (part.way === "range") return `  ${part.name}: from ${numbers[0]} to ${numbers[1]}${unit}`;
  if (part.way === "deviation") return `  ${part.name}: roots of the diagonal ${numbers.join(", ")}`;
  return `  ${part.name}: ${numbers.join(", ")}${unit}`;
}

/** All parts of a value, a line each. */
export function lines(parts: Part[], values: Float32Array): string[] {
  let place = 0;
  return parts.map((part) => partLine(part, values.subarray(place, (place += part.size))));
}

/** The room beside a wire for what it carries, in pixels. */
export const ROOM = 122;

/** The first numbers of a value, for a wire: as many and as exact as there is room for. */
export function shortOf(parts: Part[], values: Float32Array): string {
  const first = parts[0], size = first?.size ?? 0, between = first?.way === "range" ? "…" : " ";
  let words = "";
  for (const [most, figures] of [[3, 3], [3, 2], [2, 3], [2, 2], [1, 3]]) {
    const some = Array.from(values.subarray(0, Math.min(size, most)), (x) => short(x, figures));
    words = some.join(between) + (most < Math.min(size, 3) ? " …" : "");
    if (textWidth(words, "11px") <= ROOM - 6) break;
  }
  return words;
}

export class Watched {
  readonly times: Float32Array;
  private wires = new Map<string, Wire>();
  private row = -1;

  constructor(readonly run: Run) {
    this.times = run.watch ? unpack(run.watch.times) : new Float32Array();
    for (const [key, wire] of Object.entries(run.watch?.wires ?? {})) {
      const size = wire.parts.reduce((sum, part) => sum + part.size, 0);
      this.wires.set(key, { at: unpack(wire.at), values: unpack(wire.values), parts: wire.parts, size });
    }
  }

  /** Look at the last tick that was seen up to a time; its own time. */
  look(t: number): number | undefined {
    this.row = before(this.times, t + 1e-6);
    return this.row < 0 ? undefined : this.times[this.row];
  }

  readonly values: Values = (from, out): Shown | undefined => {
    const wire = this.wires.get(`${from}.${out}`);
    if (!wire || this.row < 0) return undefined;
    const at = wire.at[this.row];
    if (!Number.isFinite(at)) return { short: "none yet", lines: ["nothing came yet"], fresh: false };
    const now = this.times[this.row];
    const values = wire.values.subarray(this.row * wire.size, (this.row + 1) * wire.size);
    const age = now - at, fresh = age < 1e-5;
    const when = fresh ? `at ${now.toFixed(3)} s:` : `at ${now.toFixed(3)} s, from ${(1e3 * age).toPrecision(3)} ms before:`;
    return { short: shortOf(wire.parts, values), lines: [when, ...lines(wire.parts, values)], fresh };
  };
}
