// The page of one run or several: picked, compared, and moved through by one slider.

import type { Run } from "./model";
import { Plan } from "./map";
import { short } from "./numbers";
import { Scope } from "./scopes";
import { Space } from "./space";
import { Watched } from "./watch";

const { Diagram, legend, tools, details, dom, given } = window.flowgraph;
const { html, button } = dom;

const runs = given<Run[]>("runs");
const header = document.querySelector("header")!, main = document.querySelector("main")!, footer = document.querySelector("footer")!;
const picker = html("select", { "aria-label": "Run" }, ...runs.map((run, k) => html("option", { value: k }, run.title)));
const other = html("select", { "aria-label": "Compare with" }, html("option", { value: -1 }, "compare with …"), ...runs.map((run, k) => html("option", { value: k }, run.title)));
const slider = html("input", { type: "range", min: 0, max: 1000, value: 0, step: "any", "aria-label": "Time" });
const clock = html("output", { class: "reading-time" });
const play = button("▶", "Play", () => void (timer ? stop() : start()));

interface At { at(t: number): void; leave?(): void }
let shown: { run: Run; watched: Watched; moved: At[]; diagram: InstanceType<typeof Diagram> };
let time = 0, timer = 0;

function start(): void {
  let last = performance.now();
  if (time >= shown.run.end) move(0);
  play.textContent = "❚❚";
  play.title = "Pause";
  const frame = (now: number) => {
    move(Math.min(time + (now - last) / 1000, shown.run.end));
    last = now;
    if (time >= shown.run.end) stop();
    else timer = requestAnimationFrame(frame);
  };
  timer = requestAnimationFrame(frame);
}

function stop(): void {
  cancelAnimationFrame(timer);
  timer = 0;
  play.textContent = "▶";
  play.title = "Play";
}

/** Show all at a time, in seconds since the start. */
function move(t: number): void {
  time = Math.min(Math.max(t, 0), shown.run.end);
  slider.value = String(time);
  const tick = shown.watched.look(time);
  const wires = shown.run.watch ? (tick === undefined ? "; nothing on the wires yet" : `; wires at ${tick.toFixed(3)} s`) : "";
  clock.textContent = `${time.toFixed(3)} s of ${shown.run.end.toFixed(1)} s${wires}`;
  shown.diagram.refresh();
  for (const part of shown.moved) part.at(time);
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

async function show(): Promise<void> {
  stop();
  for (const part of shown?.moved ?? []) part.leave?.();
  const run = runs[Number(picker.value)], second = runs[Number(other.value)] as Run | undefined;
  const beside = second === run ? undefined : second;
  const watched = new Watched(run), moved: At[] = [];
  const sheet = html("div", { class: "sheet" });
  const diagram = new Diagram(run.graph, sheet, { down: true, labels: run.watch ? 122 : 0, values: run.watch ? watched.values : undefined });
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
      const scope = new Scope(one, run, match && { panel: match, run: beside! }, move);
      moved.push(scope);
      grid.append(scope.element);
    }
    scopes.append(html("section", {}, html("h3", {}, group), grid));
  }
  scopes.append(figures(beside ? [run, beside] : [run]), ...[blocks(run)].filter((part) => part !== null));
  const left = html("div", { class: "left" }, tools(diagram), sheet, legend(diagram), panel);
  main.replaceChildren(left, scopes);
  shown = { run, watched, moved, diagram };
  window.diagram = diagram;
  slider.max = String(run.end);
  move(Math.min(time, run.end));
  await diagram.draw();
  main.dataset.shown = String(picker.value);
}

const steps = (event: KeyboardEvent) => {
  const size = event.shiftKey ? 0.1 : 0.005;
  const by: Record<string, number> = { ArrowLeft: -size, ArrowRight: size, ArrowDown: -size, ArrowUp: size, PageUp: 0.1, PageDown: -0.1 };
  if (by[event.key] === undefined) return;
  event.preventDefault();
  const { run, watched } = shown;
  if (event.shiftKey || event.key.startsWith("Page") || !watched.times.length) return move(time + by[event.key] * run.end);
  const next = by[event.key] > 0 ? watched.times.find((t) => t > time + 1e-6) : watched.times.findLast((t) => t < time - 1e-6);
  move(next ?? (by[event.key] > 0 ? run.end : 0));
};
slider.addEventListener("keydown", steps);
slider.addEventListener("input", () => move(Number(slider.value)));
picker.addEventListener("change", () => void show());
other.addEventListener("change", () => void show());
header.querySelector("p")!.hidden = runs.length > 1;
const pick = html("div", { class: "tools" });
if (runs.length > 1) pick.append(picker, other);
pick.append(dom.themeButton());
header.append(pick);
time = Number(/[#&]t=([\d.]+)/.exec(location.hash)?.[1] ?? 0); // a link may name the time: run.html#t=2.5
footer.append(html("div", { class: "time" }, play, slider, clock));
void show();
