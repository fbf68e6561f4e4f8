// Plots over time, drawn on canvas by uPlot: made when they come into view, with one cursor for all.

import uPlot from "uplot";
import { unpack, type Panel, type Run } from "./model";
import { before, colour, short } from "./numbers";

const { html, button } = window.flowgraph.dom;
const HEIGHT = 150;
type Column = (number | null)[] | Float32Array;

interface Look { stroke: string; width: number; dash?: number[]; points: boolean }

function look(name: string, dots: boolean, k: number): Look {
  const line = (stroke: string, width = 1.2, dash?: number[]): Look => ({ stroke, width: dots ? 0 : width, dash, points: dots });
  if (name === "truth") return { stroke: colour("truth"), width: 1.1, dash: [5, 3], points: false };
  if (name === "expected") return { stroke: colour("grey"), width: 1, dash: [3, 3], points: false };
  if (["estimate", "error", "innovation", "value"].includes(name)) return line(colour("estimate"));
  return line(colour(`clock-${k % 10}`));
}

/** As uPlot wants it: null where there is no number. */
function column(values: Float32Array): Column {
  return values.some(Number.isNaN) ? Array.from(values, (v) => (Number.isNaN(v) ? null : v)) : values;
}

export class Scope {
  readonly element: HTMLElement;
  private plot?: uPlot;
  private t = 0;
  private readonly value = html("span", { class: "reading" });
  private times: Float32Array;
  private lines: { name: string; y: Float32Array }[];
  private full = false;
  private readonly now = html("div", { class: "now" });
  private readonly dots: { t: Float32Array; y: Float32Array }[];
  private readonly second?: { t: Float32Array; y: Float32Array };

  constructor(readonly panel: Panel, run: Run, beside: { panel: Panel; run: Run } | undefined, private readonly pick: (t: number) => void) {
    this.times = unpack(run.times[panel.t]);
    this.lines = panel.lines.map(({ name, y }) => ({ name, y: unpack(y) }));
    this.dots = (panel.points ?? []).map((dots) => ({ t: unpack(dots.t), y: unpack(dots.y) }));
    if (beside) this.second = { t: unpack(beside.run.times[beside.panel.t]), y: unpack(beside.panel.lines[0].y) };
    const title = html("h4", {}, `${panel.title} ${panel.unit}`.trim(), panel.sigma ? html("small", {}, " with 3σ") : null, this.value);
    const words = html("p", { class: panel.wrong ? "words wrong" : "words" }, panel.words ?? "");
    if (panel.whole) {
      const whole = button("whole", `Show all of ${panel.title}, or what comes after the start`, () => {
        this.full = !this.full;
        whole.setAttribute("aria-pressed", String(this.full));
        this.plot?.redraw(true, true);
        this.plot?.setScale("x", this.span());
      });
      words.append(" ", whole);
    }
    const canvas = html("div", { class: "canvas", role: "img", "aria-label": `${panel.title} over time. ${panel.words ?? ""}` });
    canvas.style.height = `${HEIGHT}px`;
    this.element = html("section", { class: "scope" }, title, canvas, words);
    watcher.observe(canvas);
    owners.set(canvas, this);
  }

  private span(): { min: number; max: number } {
    const first = this.times[0] ?? 0, last = this.times[this.times.length - 1] ?? 1;
    return { min: first, max: last > first ? last : first + 1 };
  }

  /** Draw it; again in another look where it is drawn. */
  draw(canvas: HTMLElement): void {
    const zoomed = this.plot && { min: this.plot.scales.x.min!, max: this.plot.scales.x.max! };
    this.plot?.destroy();
    const { panel } = this, data: Column[] = [this.times as Column];
    const series: uPlot.Series[] = [{}], bands: uPlot.Band[] = [];
    const scale = { y: { range: (): [number, number] => (this.full && panel.whole ? panel.whole : panel.range) }, x: { time: false } };
    if (panel.sigma) {
      const sigma = unpack(panel.sigma), middle = this.lines.find((line) => line.name === "estimate")?.y;
      const end = (sign: number) => column(sigma.map((s, k) => (middle ? middle[k] : 0) + sign * s));
      data.push(end(1), end(-1));
      const edge = { stroke: "transparent", width: 0, points: { show: false } };
      series.push({ ...edge }, { ...edge });
      bands.push({ series: [1, 2], fill: colour("band") });
    }
    this.lines.forEach(({ name, y }, k) => {
      const { stroke, width, dash, points } = look(name, panel.dots, k);
      data.push(column(y));
      series.push({
        label: name, stroke, width, dash, spanGaps: name === "expected",
        points: { show: points, size: 4, fill: stroke, stroke }, paths: points ? () => null : undefined,
      });
    });
    const axis = { stroke: colour("grey"), grid: { stroke: colour("rule"), width: 0.5 }, ticks: { stroke: colour("rule"), size: 4 }, font: "11px system-ui" };
    const plot = new uPlot({
      width: Math.max(canvas.clientWidth, 120), height: HEIGHT, series, bands, scales: scale, padding: [6, 8, 0, 0],
      axes: [{ ...axis, size: 26, gap: 2 }, { ...axis, size: 62, gap: 3, space: 26, values: (_, splits) => splits.map((y) => short(y)) }],
      legend: { show: false },
      cursor: { y: false, points: { show: false }, drag: { x: true, y: false }, sync: { key: "time", scales: ["x", null] } },
      hooks: {
        drawClear: [(u) => this.behind(u)],
        draw: [(u) => this.over(u)],
      },
    }, data as uPlot.AlignedData, canvas);
    plot.over.addEventListener("click", (event) => this.pick(plot.posToVal(event.offsetX, "x")));
    this.plot = plot;
    plot.over.append(this.now);
    this.point();
    if (zoomed) plot.setScale("x", zoomed);
    plot.over.addEventListener("dblclick", () => plot.setScale("x", this.span()));
  }

  /** What stands behind the lines: bounds, and what sensors said. */
  private behind(u: uPlot): void {
    const { ctx, bbox } = u, { panel } = this;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    if (panel.bounds) {
      const [low, high] = panel.bounds.map((y) => u.valToPos(y, "y", true));
      ctx.fillStyle = colour("band");
      ctx.fillRect(bbox.left, high, bbox.width, low - high);
    }
    ctx.fillStyle = colour("measured");
    for (const { t, y } of this.dots) {
      for (let k = 0; k < t.length; k++) ctx.fillRect(u.valToPos(t[k], "x", true) - 1.5, u.valToPos(y[k], "y", true) - 1.5, 3, 3);
    }
    ctx.restore();
  }

  /** What stands over the lines: the run that it is compared with. */
  private over(u: uPlot): void {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    if (this.second) {
      const { t, y } = this.second;
      ctx.strokeStyle = ctx.fillStyle = colour("mark");
      ctx.lineWidth = 1.2 * devicePixelRatio;
      ctx.beginPath();
      let pen = false;
      for (let k = 0; k < t.length; k++) {
        const px = u.valToPos(t[k], "x", true), py = u.valToPos(y[k], "y", true);
        if (Number.isNaN(py)) pen = false;
        else if (this.panel.dots) ctx.fillRect(px - 1.5, py - 1.5, 3, 3);
        else if (pen) ctx.lineTo(px, py);
        else {
          ctx.moveTo(px, py);
          pen = true;
        }
      }
      ctx.stroke();
    }
    ctx.restore();
    this.point();
  }

  /** Put the cursor where the time of the slider is. */
  private point(): void {
    if (this.plot) this.now.style.transform = `translateX(${this.plot.valToPos(this.t, "x").toFixed(1)}px)`;
  }

  resize(width: number): void {
    this.plot?.setSize({ width: Math.max(width, 120), height: HEIGHT });
  }

  /** Move the cursor, and read the lines there. */
  at(t: number): void {
    this.t = t;
    const row = before(this.times, t + 1e-6);
    const words = row < 0 ? [] : this.lines.filter((l) => l.name !== "expected").map((l) => (this.lines.length > 1 ? `${l.name} ` : "") + short(l.y[row]));
    this.value.textContent = words.join("  ");
    this.point();
  }

  get drawn(): boolean {
    return this.plot !== undefined;
  }

  leave(): void {
    this.plot?.destroy();
  }
}

const owners = new WeakMap<Element, Scope>();
const resizer = new ResizeObserver((entries) => {
  for (const entry of entries) owners.get(entry.target)?.resize(entry.contentRect.width);
});
const watcher = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    const scope = owners.get(target);
    if (isIntersecting && scope && !scope.drawn) {
      scope.draw(target as HTMLElement);
      resizer.observe(target);
    }
  }
}, { rootMargin: "300px" });

document.addEventListener("recolour", () => {
  for (const canvas of document.querySelectorAll<HTMLElement>(".scope .canvas")) {
    const scope = owners.get(canvas);
    if (scope?.drawn) scope.draw(canvas);
  }
});
