// The charts of a report: boxes, bars, intervals and lines over settings or names, on canvas by uPlot.

import uPlot from "uplot";
import { html } from "./dom";
import type { Axis, Chart, ChartSeries } from "./model";
import { colour, short } from "./numbers";

const ROW = 30, WIDE = 22;

interface Spot { x: number; y: number; words: string; run?: number }

/** A chart with its key, and a line that reads what is pointed at. */
export class ChartView {
  readonly element: HTMLElement;
  private plot?: uPlot;
  private readonly host = html("div", { class: "canvas" });
  private readonly reading = html("p", { class: "words" });
  private spots: Spot[] = [];

  constructor(readonly chart: Chart, private readonly pick: (run: number) => void) {
    const key = chart.series.map(({ name, kind }, k) => html("li", {}, html("span", { class: "swatch", style: `--colour: var(--${kind === "dash" ? "ink" : hue(k)})` }), name));
    key.push(...(chart.marks.length ? [html("li", {}, html("span", { class: "swatch dash" }), chart.marks[0].name)] : []));
    this.reading.textContent = this.ask();
    this.host.setAttribute("role", "img");
    this.host.setAttribute("aria-label", `${chart.title}. ${chart.words}`);
    this.element = html("div", { class: "chart" }, html("ul", { class: "key", "aria-label": `Colours of ${chart.title}` }, ...key), this.host, this.reading);
    new ResizeObserver(() => this.draw()).observe(this.host);
    document.addEventListener("recolour", () => this.draw());
  }

  private ask(): string {
    return [this.chart.words, "Point at a mark to read it.", this.chart.series.some((s) => s.runs?.some((r) => r !== null) || s.dots?.some((d) => d.run !== null)) ? "A run with a rim is on this page: a click shows it." : ""].filter(Boolean).join(" ");
  }

  private height(): number {
    return this.chart.y.names ? 70 + ROW * this.chart.y.names.length : 320;
  }

  private draw(): void {
    const width = this.host.clientWidth, height = this.height();
    if (!width) return;
    this.plot?.destroy();
    this.spots = [];
    const { chart } = this;
    const [x, y] = [range(chart, "x"), range(chart, "y")];
    const names = chart.x.names, room = names ? (width - 90) / names.length : 0;
    const longest = names ? Math.max(...names.map((n) => n.length * 6.2)) : 0;
    const turned = longest > room;
    const axis = (of: Axis): uPlot.Axis => ({
      stroke: colour("grey"), grid: { stroke: colour("rule"), width: 0.5 }, ticks: { stroke: colour("rule"), size: 4 }, font: "11px system-ui",
      label: of.label, labelFont: "12px system-ui", labelSize: of.label ? 18 : 0,
      ...(of.names ? { splits: () => of.names!.map((_, k) => k), values: () => of.names! } : {
        filter: (_: uPlot, splits: number[]) => splits,
        values: (_: uPlot, splits: number[]) => splits.map((v) => (v === null || (of.log && !isRound(v)) ? "" : short(v))),
      }),
    });
    this.plot = new uPlot({
      width, height, padding: [10, 14, 0, 0], legend: { show: false }, cursor: { points: { show: false }, drag: { x: false, y: false } },
      scales: {
        x: { time: false, range: x, distr: chart.x.log ? 3 : 1 },
        y: { range: y, distr: chart.y.log ? 3 : 1, dir: chart.y.names ? -1 : 1 },
      },
      axes: [
        { ...axis(chart.x), ...(turned ? { rotate: -20, size: Math.min(34 + longest * 0.36, 110) } : { size: 30 }) },
        { ...axis(chart.y), size: chart.y.names ? Math.min(40 + 6.4 * Math.max(...chart.y.names.map((n) => n.length)), 0.5 * width) : 64 },
      ],
      series: [{}, { paths: () => null, points: { show: false } }],
      hooks: { draw: [(u) => this.marks(u)] },
    }, [[x[0], x[1]], [null, null]], this.host);
    const over = this.plot.over;
    over.addEventListener("mousemove", (event) => this.point(event.offsetX, event.offsetY));
    over.addEventListener("mouseleave", () => { this.reading.textContent = this.ask(); });
    over.addEventListener("click", (event) => {
      const spot = this.near(event.offsetX, event.offsetY);
      if (spot?.run !== undefined) this.pick(spot.run);
    });
  }

  private near(x: number, y: number): Spot | undefined {
    let found: Spot | undefined, best = 20;
    for (const spot of this.spots) {
      const far = Math.hypot(spot.x - x, spot.y - y);
      if (far < best) [best, found] = [far, spot];
    }
    return found;
  }

  private point(x: number, y: number): void {
    const spot = this.near(x, y);
    this.reading.textContent = spot ? spot.words : this.ask();
    this.plot!.over.style.cursor = spot?.run === undefined ? "" : "pointer";
  }

  private marks(u: uPlot): void {
    const { ctx, bbox } = u, ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineWidth = 1.4 * ratio;
    const px = (v: number) => u.valToPos(v, "x", true), py = (v: number) => u.valToPos(v, "y", true);
    this.chart.series.forEach((series, k) => this.series(ctx, series, hue(k), px, py, bbox, ratio));
    ctx.strokeStyle = colour("ink");
    ctx.setLineDash([5 * ratio, 3 * ratio]);
    for (const mark of this.chart.marks) {
      ctx.beginPath();
      if (mark.x !== undefined) {
        ctx.moveTo(px(mark.x), bbox.top);
        ctx.lineTo(px(mark.x), bbox.top + bbox.height);
      } else {
        ctx.moveTo(px(mark.from!), py(mark.y!));
        ctx.lineTo(px(mark.to!), py(mark.y!));
      }
      ctx.stroke();
    }
    ctx.restore();
  }

  private series(ctx: CanvasRenderingContext2D, series: ChartSeries, name: string, px: (v: number) => number, py: (v: number) => number, bbox: uPlot.BBox, ratio: number): void {
    const { kind, x, y } = series;
    ctx.strokeStyle = ctx.fillStyle = colour(name);
    const half = Math.min((series.width ? Math.abs(px(x[0] + series.width / 2) - px(x[0])) : WIDE / 2) * 0.9, 60 * ratio);
    const tell = (k: number) => {
      const said = series.words?.[k] ?? `${series.name}: ${short(y[k])}`;
      const run = series.runs?.[k] ?? undefined;
      this.spots.push({ x: (px(x[k]) - bbox.left) / ratio, y: (py(y[k]) - bbox.top) / ratio, words: said, run: run ?? undefined });
    };
    if (kind === "line") {
      if (series.low && series.high) {
        ctx.globalAlpha = 0.2;
        ctx.beginPath();
        x.forEach((v, k) => ctx.lineTo(px(v), py(series.high![k])));
        for (let k = x.length - 1; k >= 0; k--) ctx.lineTo(px(x[k]), py(series.low[k]));
        ctx.fill();
        ctx.globalAlpha = 1;
      }
      ctx.beginPath();
      x.forEach((v, k) => ctx.lineTo(px(v), py(y[k])));
      ctx.stroke();
    }
    x.forEach((v, k) => {
      const at = px(v), high = py(y[k]);
      if (kind === "box") {
        const [least, low, , top, most] = series.boxes![k].map(py);
        ctx.globalAlpha = 0.35;
        ctx.fillRect(at - half, top, 2 * half, low - top);
        ctx.globalAlpha = 1;
        ctx.strokeRect(at - half, top, 2 * half, low - top);
        ctx.beginPath();
        for (const [a, b] of [[least, low], [top, most]]) {
          ctx.moveTo(at, a);
          ctx.lineTo(at, b);
        }
        ctx.stroke();
        ctx.fillStyle = colour("ink");
        ctx.fillRect(at - half, high - ratio, 2 * half, 2 * ratio);
        ctx.fillStyle = colour(name);
      } else if (kind === "bar") {
        ctx.globalAlpha = 0.75;
        ctx.fillRect(at - half, high, 2 * half, bbox.top + bbox.height - high);
        ctx.globalAlpha = 1;
      } else if (kind === "dash") {
        ctx.fillStyle = colour("ink");
        ctx.fillRect(at - half, high - 1.5 * ratio, 2 * half, 3 * ratio);
        ctx.fillStyle = colour(name);
      } else {
        this.dot(ctx, at, high, name, ratio, series.runs?.[k] ?? null);
      }
      if (series.low && series.high && kind !== "line" && Number.isFinite(series.low[k] + series.high[k])) {
        const across = this.chart.y.names !== null && this.chart.y.names !== undefined;
        ctx.strokeStyle = kind === "bar" ? colour("ink") : colour(name);
        ctx.lineWidth = (across ? 3 : 1.4) * ratio;
        ctx.beginPath();
        if (across) {
          ctx.moveTo(px(series.low[k]), high);
          ctx.lineTo(px(series.high[k]), high);
        } else {
          ctx.moveTo(at, py(series.low[k]));
          ctx.lineTo(at, py(series.high[k]));
        }
        ctx.stroke();
        ctx.lineWidth = 1.4 * ratio;
      }
      tell(k);
    });
    for (const { x: place, y: value, words, run } of series.dots ?? []) {
      const at = px(place), high = py(value);
      this.dot(ctx, at, high, name, ratio, run);
      this.spots.push({ x: (at - bbox.left) / ratio, y: (high - bbox.top) / ratio, words, run: run ?? undefined });
    }
  }

  /** A run, with a rim where it is on the page. */
  private dot(ctx: CanvasRenderingContext2D, x: number, y: number, name: string, ratio: number, run: number | null): void {
    ctx.beginPath();
    ctx.arc(x, y, 3.2 * ratio, 0, 7);
    ctx.fill();
    if (run === null) return;
    ctx.strokeStyle = colour("ink");
    ctx.beginPath();
    ctx.arc(x, y, 5.6 * ratio, 0, 7);
    ctx.stroke();
    ctx.strokeStyle = colour(name);
  }
}

/** Whether a number is 1, 2 or 5 times a power of ten: what is written at an axis of orders. */
function isRound(v: number): boolean {
  const first = v / 10 ** Math.floor(Math.log10(v) + 1e-9);
  return [1, 2, 5].some((n) => Math.abs(first - n) < 1e-6);
}

function hue(k: number): string {
  return `clock-${k % 10}`;
}

/** What an axis shows: half a place beside the first and last name; else all values with some room. */
function range(chart: Chart, side: "x" | "y"): [number, number] {
  const axis = chart[side];
  if (axis.names) return [-0.6, axis.names.length - 0.4];
  const across = Boolean(chart.y.names), ends = (across ? side === "x" : side === "y");
  const values = chart.series.flatMap((s) => [...s[side], ...(s.dots ?? []).map((d) => d[side]), ...(ends ? [...(s.low ?? []), ...(s.high ?? []), ...(s.boxes ?? []).flat()] : [])]);
  values.push(...chart.marks.flatMap((m) => (side === "x" ? [m.x, m.from, m.to] : [m.y])).filter((v) => v !== undefined));
  const known = values.filter((v) => Number.isFinite(v) && (!axis.log || v > 0));
  if (!known.length) return axis.log ? [0.1, 10] : [0, 1];
  const low = Math.min(...known), high = Math.max(...known);
  if (axis.log) return [low / (high / low) ** 0.06 / 1.02, high * (high / low) ** 0.06 * 1.02];
  const bars = side === "y" && chart.series.some((s) => s.kind === "bar");
  const room = 0.07 * (high - low) || 0.1 * Math.abs(high) || 1;
  return [bars ? Math.min(0, low) : low - room, high + room];
}
