// The page of a run that goes on: the diagram with what is on its wires now, and the last of it over time.

import uPlot from "uplot";
import type { Shown } from "./diagram";
import type { Graph, Part } from "./model";
import { colour } from "./numbers";
import { lines as linesOf, ROOM, shortOf } from "./watch";

const { Diagram, legend, tools, details, dom, given } = window.flowgraph;
const { html } = dom;
const KEPT = 1200, MOST = 6, HEIGHT = 140;

type Message = { t: number; ticks: number; wires: Record<string, [number, (number | null)[]]>; facts: Record<string, string> }
  | { ended: true; ticks: number; blocks: Record<string, [number, number]>; facts: Record<string, string> };

const graph = given<Graph>("graph"), parts = given<Record<string, Part[]>>("parts");
const main = document.querySelector("main")!, footer = document.querySelector("footer")!;
const state = html("output", { class: "reading-time", "aria-live": "off" }, "waiting for the run");
const times: number[] = [], seen = new Map<string, (number | null)[][]>();
let now: Record<string, [number, Float32Array]> = {}, t = 0, ticks = 0, waiting = false;

const values = (from: number, out: number): Shown | undefined => {
  const key = `${from}.${out}`, found = now[key];
  if (!parts[key] || !times.length) return undefined;
  if (!found) return { short: "none yet", lines: ["nothing came yet"], fresh: false };
  const age = t - found[0], fresh = age < 1e-5;
  return {
    short: shortOf(parts[key], found[1]), fresh,
    lines: [fresh ? `at ${t.toFixed(3)} s:` : `at ${t.toFixed(3)} s, from ${(1e3 * age).toPrecision(3)} ms before:`, ...linesOf(parts[key], found[1])],
  };
};

const sheet = html("div", { class: "sheet" });
const diagram = new Diagram(graph, sheet, { down: true, labels: ROOM, values });

interface Trace { plot: uPlot; key: string; first: number; size: number }
const traces: Trace[] = [];
const scopes = html("div", { class: "scopes", tabindex: "0", role: "region", "aria-label": "Outputs over time" }, html("h3", {}, "Outputs"));

/** What is told beside the wires: of a live run, what became of its events. */
const facts = html("table", {}), told = html("section", { class: "figures facts" }, html("h3", {}, "Events and times"), facts);
let shownFacts = "";
function tell(found: Record<string, string>): void {
  const words = JSON.stringify(found);
  if (words === shownFacts) return;
  shownFacts = words;
  if (!told.isConnected) scopes.append(told);
  facts.replaceChildren(html("tbody", {}, ...Object.entries(found).map(([name, value]) => html("tr", {}, html("th", { scope: "row" }, name), html("td", {}, value)))));
}

/** A plot for each small part of what the graph gives. */
function plots(): void {
  const grid = html("div", { class: "grid" });
  scopes.append(grid);
  for (const edge of graph.edges) {
    const head = graph.nodes[edge.to]!;
    if (head.kind !== "output") continue;
    const key = `${edge.from}.${edge.out ?? 0}`;
    let first = 0;
    for (const part of parts[key] ?? []) {
      if (part.way === "whole" && part.size >= 1 && part.size <= MOST) {
        const host = html("div", { class: "canvas", role: "img", "aria-label": `${head.name} ${part.name} over time` });
        const title = part.name === "value" ? head.name : `${head.name}: ${part.name}`;
        grid.append(html("section", { class: "scope" }, html("h4", {}, `${title} ${part.unit ? `[${part.unit}]` : ""}`.trim()), host));
        traces.push({ plot: plot(host, part.size), key, first, size: part.size });
      }
      first += part.size;
    }
  }
}

function plot(host: HTMLElement, size: number): uPlot {
  const axis = { stroke: () => colour("grey"), grid: { stroke: () => colour("rule"), width: 0.5 }, font: "11px system-ui" };
  const series: uPlot.Series[] = [{}], paths = uPlot.paths.stepped!({ align: 1 }); // a value holds until the next
  for (let k = 0; k < size; k++) series.push({ stroke: () => colour(`clock-${k}`), width: 1.2, paths, points: { show: false } });
  const made = new uPlot({
    width: Math.max(host.clientWidth, 300), height: HEIGHT, series, legend: { show: false }, scales: { x: { time: false }, y: { range: (_, low, high) => span(low, high) } },
    axes: [{ ...axis, size: 26 }, { ...axis, size: 56, space: 26 }], cursor: { show: false },
  }, [[], ...Array.from({ length: size }, () => [])] as uPlot.AlignedData, host);
  new ResizeObserver(() => made.setSize({ width: Math.max(host.clientWidth, 120), height: HEIGHT })).observe(host);
  return made;
}

/** What a plot shows of values from `low` to `high`; of one that stays, something around it. */
function span(low: number | null, high: number | null): [number, number] {
  if (low === null || high === null) return [0, 1];
  const room = 0.08 * (high - low) || 0.1 * Math.abs(low) || 1;
  return [low - room, high + room];
}

function draw(): void {
  waiting = false;
  for (const { plot: one, key, first, size } of traces) {
    const rows = seen.get(key) ?? [];
    const begin = times.length - rows.length;
    const columns = Array.from({ length: size }, (_, k) => rows.map((row) => row[first + k] ?? null));
    one.setData([times.slice(begin), ...columns] as uPlot.AlignedData);
  }
  diagram.refresh();
}

function take(message: Message): void {
  ticks = message.ticks;
  if (Object.keys(message.facts).length) tell(message.facts);
  if ("ended" in message) {
    state.textContent = `ended at ${t.toFixed(3)} s, ${ticks} ticks`;
    main.dataset.ended = "";
    return;
  }
  t = message.t;
  now = Object.fromEntries(Object.entries(message.wires).map(([key, [at, numbers]]) => [key, [at, Float32Array.from(numbers, (x) => x ?? NaN)]]));
  times.push(t);
  for (const key of new Set(traces.map((trace) => trace.key))) {
    const rows = seen.get(key) ?? [];
    rows.push(message.wires[key]?.[1] ?? []);
    if (rows.length > KEPT) rows.shift();
    seen.set(key, rows);
  }
  if (times.length > KEPT) times.shift();
  state.textContent = `${t.toFixed(3)} s, ${ticks} ticks`;
  if (!waiting) {
    waiting = true;
    requestAnimationFrame(draw);
  }
}

main.append(html("div", { class: "left" }, tools(diagram), sheet, legend(diagram), details(diagram)), scopes);
document.querySelector("header")!.append(html("div", { class: "tools" }, dom.themeButton()));
footer.append(html("div", { class: "time" }, state));
document.addEventListener("recolour", () => draw());
window.diagram = diagram;
plots();
void diagram.draw().then(() => {
  const socket = new WebSocket(`ws://${location.host}/live`);
  socket.addEventListener("message", (event) => take(JSON.parse(event.data as string) as Message));
  socket.addEventListener("close", () => {
    if (main.dataset.ended === undefined) state.textContent += "; the run is no longer there";
  });
});
