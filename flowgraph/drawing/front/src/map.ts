// A plan of the place, where a satellite receiver was heard: the way from above, to scale, with north.

import { unpack, type Way } from "./model";
import { before, colour, short } from "./numbers";

const { html } = window.flowgraph.dom;

export class Plan {
  readonly element: HTMLElement;
  private canvas = html("canvas", { role: "img", "aria-label": "The way from above, north up, with what the satellite receivers said" });
  private paths: { places: Float32Array; name: string; dots: boolean }[];
  private times: Float32Array;
  private t = 0;

  constructor(readonly way: Way, beside?: Way) {
    this.element = html("section", { class: "plan" }, html("h4", {}, "Map, x east, y north"), html("div", { class: "frame3d" }, this.canvas),
      html("p", { class: "words" }, `dots: ${way.seen.filter((s) => s.gnss).map((s) => s.name).join(", ")}`));
    this.times = unpack(way.t);
    this.paths = way.seen.filter((s) => s.gnss).map((s) => ({ places: unpack(s.places), name: "measured", dots: true }));
    if (way.truth) this.paths.push({ places: unpack(way.truth), name: "truth", dots: false });
    this.paths.push({ places: unpack(way.estimate), name: "estimate", dots: false });
    if (beside) this.paths.push({ places: unpack(beside.estimate), name: "mark", dots: false });
    new ResizeObserver(() => this.draw()).observe(this.canvas.parentElement!);
    document.addEventListener("recolour", () => this.draw());
  }

  at(t: number): void {
    this.t = t;
    this.draw();
  }

  private draw(): void {
    const { canvas } = this, host = canvas.parentElement!, w = host.clientWidth, h = host.clientHeight, ratio = devicePixelRatio;
    if (!w || !h) return;
    canvas.width = w * ratio;
    canvas.height = h * ratio;
    canvas.style.width = `${w}px`;
    canvas.style.height = `${h}px`;
    const ctx = canvas.getContext("2d")!;
    ctx.scale(ratio, ratio);
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const { places } of this.paths) {
      for (let k = 0; k < places.length; k += 3) {
        if (!Number.isFinite(places[k] + places[k + 1])) continue;
        left = Math.min(left, places[k]);
        right = Math.max(right, places[k]);
        low = Math.min(low, places[k + 1]);
        high = Math.max(high, places[k + 1]);
      }
    }
    if (!Number.isFinite(left)) return;
    const scale = Math.min((w - 40) / Math.max(right - left, 1e-6), (h - 52) / Math.max(high - low, 1e-6));
    const x = (e: number) => w / 2 + (e - (left + right) / 2) * scale, y = (n: number) => (h - 16) / 2 - (n - (low + high) / 2) * scale;
    for (const { places, name, dots } of this.paths) {
      ctx.strokeStyle = ctx.fillStyle = colour(name);
      ctx.setLineDash(name === "truth" ? [5, 3] : []);
      ctx.lineWidth = 1.4;
      ctx.beginPath();
      for (let k = 0; k < places.length; k += 3) {
        if (!Number.isFinite(places[k] + places[k + 1])) continue;
        if (dots) ctx.fillRect(x(places[k]) - 1.5, y(places[k + 1]) - 1.5, 3, 3);
        else ctx.lineTo(x(places[k]), y(places[k + 1]));
      }
      if (!dots) ctx.stroke();
    }
    ctx.setLineDash([]);
    const path = this.paths.find((p) => p.name === "estimate")!.places, row = Math.max(before(this.times, this.t + 1e-6), 0);
    ctx.fillStyle = colour("wrong");
    ctx.beginPath();
    ctx.arc(x(path[3 * row]), y(path[3 * row + 1]), 4.5, 0, 7);
    ctx.fill();
    // a bar of a round length, and an arrow to the north
    const rough = 110 / scale, unit = 10 ** Math.floor(Math.log10(rough)), length = [5, 2, 1].map((m) => m * unit).find((m) => m <= rough) ?? unit;
    ctx.strokeStyle = ctx.fillStyle = colour("ink");
    ctx.lineWidth = 1.5;
    ctx.beginPath();
    ctx.moveTo(12, h - 16);
    ctx.lineTo(12, h - 10);
    ctx.lineTo(12 + length * scale, h - 10);
    ctx.lineTo(12 + length * scale, h - 16);
    ctx.moveTo(w - 16, 34);
    ctx.lineTo(w - 16, 10);
    ctx.lineTo(w - 20, 18);
    ctx.moveTo(w - 16, 10);
    ctx.lineTo(w - 12, 18);
    ctx.stroke();
    ctx.font = "11px system-ui, sans-serif";
    ctx.fillText(`${short(length)} ${this.way.unit}`, 18 + length * scale, h - 9);
    ctx.fillText("N", w - 20, 46);
  }
}
