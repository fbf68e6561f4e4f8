// A run beside its diagram, or several: picked, compared, and moved through by one slider.

import type { Run } from "./model";
import { Plan } from "./map";
import { short } from "./numbers";
import { Scope } from "./scopes";
import { Space } from "./space";
import { ROOM, Watched } from "./watch";

const { Diagram, legend, tools, details, dom } = window.flowgraph;
const { html, button } = dom;

interface At { at(t: number): void; leave?(): void }

export class RunView {
  /** The diagram on the left and the plots on the right. */
  readonly element = html("div", { class: "beside" });
  /** Which run is shown, and which is compared with it. */
  readonly picks = html("div", { class: "tools" });
  /** The slider with its time. */
  readonly bar: HTMLElement;
  private picker: HTMLSelectElement;
  private other: HTMLSelectElement;
  private slider = html("input", { type: "range", min: 0, max: 1000, value: 0, step: "any", "aria-label": "Time" });
  private clock = html("output", { class: "reading-time" });
  private play = button("▶", "Play", () => void (this.timer ? this.stop() : this.start()));
  private shown!: { run: Run; watched: Watched; moved: At[]; diagram: InstanceType<typeof Diagram> };
  private timer = 0;

  /** `time`: where the slider stands at first; `told`: called when a run stands there whole. */
  constructor(readonly runs: Run[], private time: number, private readonly told: (run: number) => void) {
    const titles = runs.map((run, k) => html("option", { value: k }, run.title));
    this.picker = html("select", { "aria-label": "Run" }, ...titles);
    this.other = html("select", { "aria-label": "Compare with" }, html("option", { value: -1 }, "compare with …"), ...titles.map((one) => one.cloneNode(true)));
    if (runs.length > 1) this.picks.append(this.picker, this.other);
    this.bar = html("div", { class: "time" }, this.play, this.slider, this.clock);
    this.slider.addEventListener("keydown", (event) => this.step(event));
    this.slider.addEventListener("input", () => this.move(Number(this.slider.value)));
    this.picker.addEventListener("change", () => void this.show());
    this.other.addEventListener("change", () => void this.show());
    void this.show();
  }

  /** Show a run; the one that was shown is what it is compared with, where that is asked for. */
  pick(run: number, compared = false): void {
    if (compared && Number(this.picker.value) !== run) this.other.value = this.picker.value;
    this.picker.value = String(run);
    void this.show();
  }

  private start(): void {
    let last = performance.now();
    if (this.time >= this.shown.run.end) this.move(0);
    this.play.textContent = "❚❚";
    this.play.title = "Pause";
    const frame = (now: number) => {
      this.move(Math.min(this.time + (now - last) / 1000, this.shown.run.end));
      last = now;
      if (this.time >= this.shown.run.end) this.stop();
      else this.timer = requestAnimationFrame(frame);
    };
    this.timer = requestAnimationFrame(frame);
  }

  private stop(): void {
    cancelAnimationFrame(this.timer);
    this.timer = 0;
    this.play.textContent = "▶";
    this.play.title = "Play";
  }

  /** Show all at a time, in seconds since the start. */
  private move(t: number): void {
    const { run, watched, diagram, moved } = this.shown;
    this.time = Math.min(Math.max(t, 0), run.end);
    this.slider.value = String(this.time);
    const tick = watched.look(this.time);
    const wires = run.watch ? (tick === undefined ? "; nothing on the wires yet" : `; wires at ${tick.toFixed(3)} s`) : "";
    this.clock.textContent = `${this.time.toFixed(3)} s of ${run.end.toFixed(1)} s${wires}`;
    diagram.refresh();
    for (const part of moved) part.at(this.time);
  }

  private async show(): Promise<void> {
    this.stop();
    for (const part of this.shown?.moved ?? []) part.leave?.();
    const run = this.runs[Number(this.picker.value)], second = this.runs[Number(this.other.value)] as Run | undefined;
    const beside = second === run ? undefined : second;
    const watched = new Watched(run), moved: At[] = [];
    const sheet = html("div", { class: "sheet" });
    const diagram = new Diagram(run.graph, sheet, { down: true, labels: run.watch ? ROOM : 0, values: run.watch ? watched.values : undefined });
    const panel = details(diagram, (node) => {
      const path = node === undefined ? undefined : run.graph.nodes[node]?.path;
      const took = path === undefined ? undefined : run.blocks[path];
      return took ? [html("p", { class: "took" }, `${short(took[0])} µs a firing, ${took[1]} firings`)] : [];
    });
    const scopes = html("div", { class: "scopes", tabindex: "0", role: "region", "aria-label": "Plots of the run" });
    scopes.append(...[notes(run)].filter((part) => part !== null), key(run, beside));
    if (run.way) {
      const places = html("div", { class: "places" });
      const space = new Space(run, run.way, beside?.way ?? undefined);
      moved.push(space);
      places.append(space.element);
      if (run.way.seen.some((s) => s.gnss)) {
        const plan = new Plan(run.way, beside?.way ?? undefined);
        moved.push(plan);
        places.append(plan.element);
      }
      scopes.append(places);
    }
    for (const group of [...new Set(run.panels.map((p) => p.group))]) {
      const grid = html("div", { class: "grid" });
      for (const one of run.panels.filter((p) => p.group === group)) {
        const match = beside?.panels.find((p) => p.group === group && p.title === one.title);
        const scope = new Scope(one, run, match && { panel: match, run: beside! }, (t) => this.move(t));
        moved.push(scope);
        grid.append(scope.element);
      }
      scopes.append(html("section", {}, html("h3", {}, group), grid));
    }
    scopes.append(figures(beside ? [run, beside] : [run]), ...[blocks(run)].filter((part) => part !== null));
    const left = html("div", { class: "left" }, tools(diagram), sheet, legend(diagram), panel);
    this.element.replaceChildren(left, scopes);
    this.shown = { run, watched, moved, diagram };
    window.diagram = diagram;
    this.slider.max = String(run.end);
    this.move(Math.min(this.time, run.end));
    await diagram.draw();
    this.told(Number(this.picker.value));
  }

  private step(event: KeyboardEvent): void {
    const size = event.shiftKey ? 0.1 : 0.005;
    const by: Record<string, number> = { ArrowLeft: -size, ArrowRight: size, ArrowDown: -size, ArrowUp: size, PageUp: 0.1, PageDown: -0.1 };
    if (by[event.key] === undefined) return;
    event.preventDefault();
    const { run, watched } = this.shown, { time } = this;
    if (event.shiftKey || event.key.startsWith("Page") || !watched.times.length) return this.move(time + by[event.key] * run.end);
    const next = by[event.key] > 0 ? watched.times.find((t) => t > time + 1e-6) : watched.times.findLast((t) => t < time - 1e-6);
    this.move(next ?? (by[event.key] > 0 ? run.end : 0));
  }
}

function figures(chosen: Run[]): HTMLElement {
  const keys = [...new Set(chosen.flatMap((run) => run.figures.map(([key]) => key)))];
  const head = chosen.length > 1 ? html("thead", {}, html("tr", {}, html("td", {}), ...chosen.map((run) => html("th", { scope: "col" }, run.title)))) : null;
  const rows = keys.map((key) => html("tr", {}, html("th", { scope: "row" }, key.replaceAll("_", " ")),
    ...chosen.map((run) => html("td", {}, run.figures.find(([k]) => k === key)?.[1] ?? ""))));
  return html("section", { class: "figures" }, html("h3", {}, "Figures"), html("table", {}, head, html("tbody", {}, ...rows)));
}

function notes(run: Run): HTMLElement | null {
  if (!run.notes.length) return null;
  const wrong = /^(warning|diverged|refused)/;
  return html("section", { class: "notes" }, html("h3", {}, "Notes"),
    html("ul", {}, ...run.notes.map((words) => html("li", { class: wrong.test(words) ? "wrong" : undefined }, words))));
}

/** What the colours of the plots mean. */
function key(run: Run, beside: Run | undefined): HTMLElement {
  const entry = (name: string, words: string) => html("li", {}, html("span", { class: "swatch", style: `--colour: var(--${name})` }), words);
  const seen = run.way?.seen.map((s) => s.name).join(", ");
  return html("ul", { class: "key", "aria-label": "Colours of the plots" }, entry("estimate", "estimate, error, innovation"), entry("truth", "truth (dashed)"),
    seen ? entry("measured", `measured: ${seen}`) : null, entry("band", "3σ, or 95 % bounds"), beside ? entry("mark", beside.title) : null);
}

function blocks(run: Run): HTMLElement | null {
  const all = Object.entries(run.blocks).map(([path, [micros, times]]) => ({ path, micros, times, sum: micros * times }));
  const sum = all.reduce((total, one) => total + one.sum, 0);
  if (!sum) return null;
  const row = (one: (typeof all)[number]) => html("tr", {}, html("th", { scope: "row" }, one.path), html("td", {}, short(one.micros)), html("td", {}, String(one.times)),
    html("td", {}, html("meter", { min: 0, max: 1, value: one.sum / sum, "aria-label": `share of ${one.path}` }), ` ${((100 * one.sum) / sum).toFixed(1)} %`));
  return html("section", { class: "times" }, html("h3", {}, "Time of each block"),
    html("table", {}, html("thead", {}, html("tr", {}, ...["block", "µs a firing", "firings", "share"].map((w) => html("th", { scope: "col" }, w)))),
      html("tbody", {}, ...all.sort((a, b) => b.sum - a.sum).map(row))));
}
