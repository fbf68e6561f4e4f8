// The diagram: drawn from a layout, folded and unfolded, searched, and asked about its parts.

import { button, cut, html, svg } from "./dom";
import { foldedAround, layOut, type Box, type Frame, type Line, type Picture } from "./layout";
import type { Edge, Graph, Node, Port } from "./model";
import { View } from "./view";

const COLOURS = 10;
const READABLE = 0.85;

/** What a run shows on a wire at a time: a few characters on it, lines in the tip, and whether it is of now. */
export interface Shown { short: string; lines: string[]; fresh: boolean }
export type Values = (from: number, out: number) => Shown | undefined;

export class Diagram {
  readonly folded: Set<string>;
  down: boolean;
  picture?: Picture;
  selected?: number;
  onSelect: (node: number | undefined) => void = () => {};
  private readonly frame = svg("svg", { class: "diagram", role: "group", tabindex: "0" });
  private readonly moved = svg("g");
  private readonly tip = html("div", { class: "tip", role: "tooltip", id: "tip", hidden: true });
  private readonly view = new View(this.frame, this.moved);
  private labels = new Map<string, SVGTextElement>();
  private drawing = 0;

  constructor(readonly graph: Graph, readonly host: HTMLElement, readonly options: { down?: boolean; folded?: string[]; labels?: number; values?: Values } = {}) {
    const many = graph.nodes.filter(Boolean).length > 60;
    this.folded = new Set(options.folded ?? (many ? graph.scopes.map((s) => s.path) : []));
    this.down = options.down ?? false;
    this.frame.setAttribute("aria-label", `Block diagram of ${graph.name}. Arrow keys move it, plus and minus zoom, 0 shows all.`);
    this.frame.append(this.moved);
    host.append(this.frame, this.tip);
    this.frame.addEventListener("keydown", (event) => this.key(event));
    this.frame.addEventListener("click", (event) => {
      if (event.target === this.frame) this.select(undefined);
    });
    addEventListener("beforeprint", () => this.forPrint());
    addEventListener("afterprint", () => this.onScreen());
  }

  /** The first drawing, in the direction in which more of it can be read. */
  async start(): Promise<void> {
    await this.draw();
    if (this.options.down === undefined && this.picture && this.room(this.picture) < READABLE) {
      const other = await layOut(this.graph, this.folded, !this.down, this.options.labels);
      if (this.room(other) > 1.15 * this.room(this.picture)) await this.turn();
    }
  }

  /** How large a whole picture could be shown. */
  private room(picture: Picture): number {
    return Math.min(this.frame.clientWidth / picture.width, this.frame.clientHeight / picture.height);
  }

  /** Lay out and draw what is unfolded now. */
  async draw(fit = true): Promise<void> {
    const turn = ++this.drawing;
    const picture = await layOut(this.graph, this.folded, this.down, this.options.labels);
    if (turn !== this.drawing) return;
    const focused = document.activeElement?.getAttribute("data-key");
    this.picture = picture;
    this.labels.clear();
    const group = (name: string, ...children: SVGElement[]) => svg("g", { class: name }, ...children);
    this.moved.replaceChildren(
      group("frames", ...picture.frames.filter((f) => !f.folded).map((f) => this.frameOf(f))),
      group("lines", ...picture.lines.map((line) => this.lineOf(line))),
      group("boxes", ...picture.frames.filter((f) => f.folded).map((f) => this.frameOf(f)),
        ...picture.boxes.map((box) => this.boxOf(box))),
    );
    this.hideTip();
    if (fit) this.fit();
    else this.view.show();
    if (focused) this.moved.querySelector<SVGElement>(`[data-key="${CSS.escape(focused)}"]`)?.focus();
    this.mark();
    this.refresh();
    this.host.dataset.drawn = String(turn);
    document.body.dataset.drawnMs ??= performance.now().toFixed(1);
  }

  fit(): void {
    if (this.picture) this.view.fit(this.picture.width, this.picture.height, READABLE);
  }

  whole(): void {
    if (this.picture) this.view.fit(this.picture.width, this.picture.height, 0.08);
  }

  zoom(by: number): void {
    this.view.scale(by);
  }

  async turn(): Promise<void> {
    this.down = !this.down;
    await this.draw();
  }

  async foldAll(shut: boolean): Promise<void> {
    this.folded.clear();
    if (shut) for (const scope of this.graph.scopes) this.folded.add(scope.path);
    await this.draw();
  }

  async toggle(scope: string): Promise<void> {
    if (!this.folded.delete(scope)) this.folded.add(scope);
    const before = this.picture?.frames.find((f) => f.scope === scope);
    await this.draw(false);
    const after = this.picture?.frames.find((f) => f.scope === scope);
    if (before && after) this.view.move((before.x - after.x) * this.view.zoom, (before.y - after.y) * this.view.zoom);
  }

  /** The nodes whose name, block or documentation has these words, the best first. */
  search(words: string): number[] {
    const parts = words.toLowerCase().split(/\s+/).filter(Boolean);
    if (!parts.length) return [];
    const rank = (node: Node): number => {
      const types = [...node.ins, ...node.outs].map((p) => this.graph.types[p.type].words).join(" ");
      const texts = [node.path, node.block ?? "", types, node.doc ?? ""].map((t) => t.toLowerCase());
      const places = parts.map((part) => texts.findIndex((text) => text.includes(part)));
      return places.some((place) => place < 0) ? -1 : Math.max(...places);
    };
    return this.graph.nodes.map((node, index) => ({ index, rank: node ? rank(node) : -1 }))
      .filter((found) => found.rank >= 0).sort((a, b) => a.rank - b.rank).map((found) => found.index);
  }

  /** Unfold what is around a node, bring it to the middle, and select it. */
  async reveal(index: number): Promise<void> {
    const node = this.graph.nodes[index]!;
    let shut = foldedAround(this.graph, this.folded, node.path);
    const redraw = shut !== undefined;
    while (shut !== undefined) {
      this.folded.delete(shut);
      shut = foldedAround(this.graph, this.folded, node.path);
    }
    if (redraw) await this.draw(false);
    const box = this.picture?.boxes.find((b) => b.node === index);
    if (box) this.view.centre(box.x + box.width / 2, box.y + box.height / 2);
    this.select(index);
  }

  select(index: number | undefined): void {
    this.selected = index;
    this.mark();
    this.onSelect(index);
  }

  /** Let what is on one clock stand out; nothing to end that. */
  showClock(clock: number | null | undefined): void {
    for (const line of this.moved.querySelectorAll(".line")) {
      line.classList.toggle("faint", clock !== undefined && line.getAttribute("data-clock") !== String(clock));
    }
  }

  /** Show what is on the wires now. */
  refresh(): void {
    const values = this.options.values;
    if (!values) return;
    for (const [key, label] of this.labels) {
      const [from, out] = key.split(".").map(Number);
      const shown = values(from, out);
      label.textContent = shown?.short ?? "";
      label.classList.toggle("old", shown !== undefined && !shown.fresh);
    }
  }

  portWords(node: Node, port: Port, side: "in" | "out"): string[] {
    const type = this.graph.types[port.type];
    const clock = port.clock === null ? undefined : this.graph.clocks[port.clock];
    const held = port.held === "delay" ? "held from the tick before" : port.held ? "held" : undefined;
    const lines = [`${node.path}${port.name ? "." + port.name : ""}: ${type.words}`];
    for (const leaf of type.leaves) {
      const size = leaf.shape.length ? ` ${leaf.shape.join(" × ")}` : "";
      lines.push(`  ${leaf.name}: ${leaf.dtype}${size}${leaf.unit ? `, ${leaf.unit}` : ""}${leaf.frame ? `, ${leaf.frame}` : ""}`);
    }
    lines.push(`clock: ${clock ? clock.words : held ?? "held"}`);
    if (clock?.rate) lines.push(`rate: ${clock.rate}`);
    if (port.when && clock && !clock.rate && port.when !== `at ${clock.words}`) lines.push(`when: ${port.when}`);
    if (side === "in" && port.optional) lines.push("may be absent");
    return lines;
  }

  colour(clock: number | null): string {
    return clock === null ? "var(--held)" : `var(--clock-${clock % COLOURS})`;
  }

  private portOf(edge: Edge): Port {
    const node = this.graph.nodes[edge.from]!;
    return node.outs[edge.out ?? 0];
  }

  private lineOf(line: Line): SVGElement {
    const { edge, points } = line, port = this.portOf(edge), head = this.graph.nodes[edge.to]!;
    const path = rounded(points), clock = port.clock;
    const colour = this.colour(clock);
    const kind = `line${edge.feedback ? " feedback" : ""}${edge.fires ? " fires" : ""}`;
    const group = svg("g", { class: kind, "data-clock": String(clock), "data-from": edge.from, "data-to": edge.to, style: `--colour: ${colour}` },
      svg("path", { d: path, class: "stroke" }), arrow(points, edge), svg("path", { d: path, class: "reach" }));
    const words = () => {
      const lines = this.portWords(this.graph.nodes[edge.from]!, port, "out");
      lines[0] += ` → ${head.path}${edge.port ? "." + edge.port : ""}`;
      if (edge.feedback) lines.push("read one tick later");
      if (edge.optional) lines.push("may be absent");
      const shown = this.options.values?.(edge.from, edge.out ?? 0);
      return shown ? [...lines, ...shown.lines] : lines;
    };
    this.tipOn(group, words);
    if (line.label) {
      const text = svg("text", { x: line.label.x + 2, y: line.label.y + 10, class: "value" });
      this.labels.set(`${edge.from}.${edge.out ?? 0}`, text);
      group.append(text);
    }
    return group;
  }

  private boxOf(box: Box): SVGElement {
    const node = this.graph.nodes[box.node]!;
    const body = svg("g", { class: "body", role: "button", tabindex: "0", "data-key": node.path },
      outline(node, box.width, box.height, this.down),
      box.chip && svg("rect", { class: "chip", x: box.chip.x, y: box.chip.y, width: box.chip.width, height: box.chip.height, rx: 4 }),
      ...box.texts.flatMap((t) => [svg("text", { x: t.x, y: t.y, class: t.style, "text-anchor": t.anchor }, t.words), " "]));
    const select = () => this.select(box.node);
    body.addEventListener("click", select);
    body.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        select();
      }
    });
    const ends = box.ends.map((end) => {
      const port = (end.side === "in" ? node.ins : node.outs)[end.port];
      const dot = svg("circle", {
        class: "dot", cx: end.x, cy: end.y, r: 4.5, tabindex: "0", role: "img", "data-key": end.id, style: `--colour: ${this.colour(port.clock)}`,
        "aria-label": this.portWords(node, port, end.side).join("; "),
      });
      this.tipOn(dot, () => {
        const shown = end.side === "out" ? this.options.values?.(end.node, end.port) : undefined;
        return [...this.portWords(node, port, end.side), ...(shown?.lines ?? [])];
      });
      return dot;
    });
    return svg("g", { class: `box ${node.kind}`, "data-node": box.node, transform: `translate(${box.x} ${box.y})` }, body, ...ends);
  }

  private frameOf(frame: Frame): SVGElement {
    const scope = this.graph.scopes.find((s) => s.path === frame.scope)!;
    const { width, height } = frame;
    const toggle = () => void this.toggle(frame.scope);
    const sign = svg("g", {
      class: "fold", role: "button", tabindex: "0", "data-key": `fold ${frame.scope}`, "aria-expanded": String(!frame.folded),
      "aria-label": `${frame.folded ? "Unfold" : "Fold"} the graph ${frame.scope}`, transform: "translate(8 7)",
    },
      svg("rect", { width: 16, height: 16, rx: 3 }), svg("path", { d: frame.folded ? "M4 8h8M8 4v8" : "M4 8h8" }));
    sign.addEventListener("click", toggle);
    sign.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        toggle();
      }
    });
    const area = svg("rect", { class: "area", width, height, rx: 8 });
    area.addEventListener("dblclick", toggle);
    const depth = frame.scope.split("/").length;
    return svg("g", { class: `frame${frame.folded ? " shut" : ""}`, "data-scope": frame.scope, "data-depth": depth % 2, transform: `translate(${frame.x} ${frame.y})` },
      area, svg("text", { x: 30, y: 19, class: "name" }, scope.name),
      frame.folded && svg("text", { x: 30, y: 36, class: "note" }, `${frame.blocks} block${frame.blocks === 1 ? "" : "s"}`), sign);
  }

  private mark(): void {
    for (const box of this.moved.querySelectorAll(".box")) {
      box.classList.toggle("selected", box.getAttribute("data-node") === String(this.selected));
    }
    for (const line of this.moved.querySelectorAll(".line")) {
      const ends = [line.getAttribute("data-from"), line.getAttribute("data-to")];
      line.classList.toggle("near", this.selected !== undefined && ends.includes(String(this.selected)));
    }
  }

  private tipOn(element: SVGElement, words: () => string[]): void {
    const show = (x: number, y: number) => {
      this.tip.replaceChildren(...words().map((line) => html("div", {}, line)));
      this.tip.hidden = false;
      const box = this.host.getBoundingClientRect();
      const left = Math.min(x - box.left + 14, box.width - this.tip.offsetWidth - 6);
      let top = y - box.top + 16;
      if (top + this.tip.offsetHeight > box.height - 4) top = y - box.top - this.tip.offsetHeight - 12;
      this.tip.style.left = `${Math.max(left, 4)}px`;
      this.tip.style.top = `${Math.max(top, 4)}px`;
    };
    element.addEventListener("pointermove", (event) => show(event.clientX, event.clientY));
    element.addEventListener("pointerleave", () => this.hideTip());
    element.addEventListener("focus", () => {
      if (!element.matches(":focus-visible")) return;
      const place = element.getBoundingClientRect();
      show(place.right, place.bottom);
    });
    element.addEventListener("blur", () => this.hideTip());
  }

  private hideTip(): void {
    this.tip.hidden = true;
  }

  private key(event: KeyboardEvent): void {
    const steps: Record<string, [number, number]> = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (steps[event.key]) this.view.move(...steps[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(1.2);
    else if (event.key === "-") this.zoom(1 / 1.2);
    else if (event.key === "0") this.whole();
    else if (event.key === "Escape") this.hideTip();
    else return;
    event.preventDefault();
  }

  private forPrint(): void {
    if (!this.picture) return;
    this.frame.setAttribute("viewBox", `-8 -8 ${this.picture.width + 16} ${this.picture.height + 16}`);
    this.moved.removeAttribute("transform");
  }

  private onScreen(): void {
    this.frame.removeAttribute("viewBox");
    this.view.show();
  }
}

function outline(node: Node, w: number, h: number, down: boolean): SVGElement {
  if (node.kind === "source") {
    const d = down ? `M0 0H${w}V${h - 8}L${w / 2} ${h}L0 ${h - 8}Z` : `M0 0H${w - 8}L${w} ${h / 2}L${w - 8} ${h}H0Z`;
    return svg("path", { class: "shape", d });
  }
  if (node.kind === "register") {
    return svg("g", {}, svg("rect", { class: "shape", width: w, height: h, rx: 3 }), svg("path", { class: "rim", d: `M4 0V${h}M${w - 4} 0V${h}` }));
  }
  return svg("rect", { class: "shape", width: w, height: h, rx: node.kind === "output" ? h / 2 : 6 });
}

function rounded(points: { x: number; y: number }[]): string {
  let d = `M${points[0].x} ${points[0].y}`;
  for (let k = 1; k < points.length - 1; k++) {
    const [a, b, c] = [points[k - 1], points[k], points[k + 1]];
    const before = Math.hypot(b.x - a.x, b.y - a.y), after = Math.hypot(c.x - b.x, c.y - b.y);
    const r = Math.min(5, before / 2, after / 2);
    if (!r) continue;
    d += `L${b.x + ((a.x - b.x) * r) / before} ${b.y + ((a.y - b.y) * r) / before}Q${b.x} ${b.y} ${b.x + ((c.x - b.x) * r) / after} ${b.y + ((c.y - b.y) * r) / after}`;
  }
  const last = points[points.length - 1];
  return `${d}L${last.x} ${last.y}`;
}

/** The head of an arrow; hollow where what it brings may be absent. */
function arrow(points: { x: number; y: number }[], edge: Edge): SVGElement {
  const end = points[points.length - 1];
  const from = [...points].reverse().find((p) => Math.hypot(p.x - end.x, p.y - end.y) > 0.5) ?? end;
  const angle = (Math.atan2(end.y - from.y, end.x - from.x) * 180) / Math.PI;
  return svg("path", { class: `head${edge.optional ? " hollow" : ""}`, d: "M0 0L-9 -4V4Z", transform: `translate(${end.x} ${end.y}) rotate(${angle})` });
}

/** What the colours of the wires mean. */
export function legend(diagram: Diagram): HTMLElement {
  const { graph } = diagram;
  const used = new Set<number | null>(graph.edges.map((e) => graph.nodes[e.from]!.outs[e.out ?? 0].clock));
  const entry = (clock: number | null, words: string, more: string) => {
    const made = html("button", { type: "button", class: "clock", title: more, style: `--colour: ${diagram.colour(clock)}` },
      html("span", { class: "swatch" }), words);
    for (const on of ["pointerenter", "focus"]) made.addEventListener(on, () => diagram.showClock(clock));
    for (const off of ["pointerleave", "blur"]) made.addEventListener(off, () => diagram.showClock(undefined));
    return html("li", {}, made);
  };
  const list = html("ul", { class: "legend", "aria-label": "What the colours and lines of the wires mean" });
  graph.clocks.forEach((clock, k) => {
    const rate = clock.rate && clock.rate !== clock.words ? `, ${clock.rate}` : "";
    if (used.has(k)) list.append(entry(k, cut(clock.words, 34) + rate, `at ${clock.words}${rate}`));
  });
  if (used.has(null)) list.append(entry(null, "held", "what a register remembers"));
  const line = (kind: string, words: string) => {
    const sample = svg("svg", { width: 30, height: 10, "aria-hidden": "true" });
    sample.append(svg("path", { class: `sample ${kind}`, d: "M1 5H22" }), svg("path", { class: `head ${kind}`, d: "M29 5l-9-4v8z" }));
    list.append(html("li", { class: "kind" }, sample, words));
  };
  if (graph.edges.some((e) => e.feedback)) line("feedback", "read one tick later");
  if (graph.edges.some((e) => e.optional)) line("hollow", "may be absent");
  if (graph.edges.some((e) => e.fires)) line("fires", "only fires");
  return list;
}

/** The tools above a diagram: search, fold, zoom, turn. */
export function tools(diagram: Diagram): HTMLElement {
  const field = html("input", { type: "search", placeholder: "Search", "aria-label": "Search blocks, ports' types and documentation", title: "Search (/)" });
  const found = html("ul", { class: "found", "aria-label": "Found", hidden: true });
  const list = () => {
    const hits = diagram.search(field.value).slice(0, 12);
    found.hidden = !hits.length && !field.value.trim();
    const items = hits.map((index) => {
      const node = diagram.graph.nodes[index]!;
      const choose = html("button", { type: "button" }, node.path, node.block ? html("small", {}, ` ${node.block}`) : null);
      choose.addEventListener("click", () => {
        found.hidden = true;
        void diagram.reveal(index);
      });
      return html("li", {}, choose);
    });
    found.replaceChildren(...(items.length ? items : [html("li", { class: "none" }, "Nothing has these words")]));
    return hits;
  };
  let next = 0;
  field.addEventListener("input", () => {
    next = 0;
    list();
  });
  field.addEventListener("keydown", (event) => {
    if (event.key === "Enter") {
      const hits = list();
      if (hits.length) void diagram.reveal(hits[next++ % hits.length]);
      found.hidden = true;
    } else if (event.key === "Escape") {
      field.value = "";
      found.hidden = true;
    }
  });
  document.addEventListener("keydown", (event) => {
    const typing = (event.target as HTMLElement).closest("input, select, textarea");
    if (event.key === "/" && !typing) {
      event.preventDefault();
      field.focus();
    }
  });
  document.addEventListener("pointerdown", (event) => {
    if (!(event.target as HTMLElement).closest(".search")) found.hidden = true;
  });
  const bar = html("div", { class: "tools" }, html("div", { class: "search" }, field, found));
  if (diagram.graph.scopes.length) {
    bar.append(button("Fold", "Fold all graphs", () => void diagram.foldAll(true)), button("Unfold", "Unfold all graphs", () => void diagram.foldAll(false)));
  }
  bar.append(
    button("−", "Smaller", () => diagram.zoom(1 / 1.25)), button("+", "Larger", () => diagram.zoom(1.25)),
    button("All", "Show the whole diagram", () => diagram.whole()),
    button("⤢", "Turn: from left to right, or from top to bottom", () => void diagram.turn()),
  );
  return bar;
}
