// Where everything stands: the boxes with their texts and ports, given to ELK, which places them.

import ELK from "elkjs/lib/elk.bundled.js";
import type { ElkExtendedEdge, ElkNode } from "elkjs/lib/elk-api";
import { cut, textWidth } from "./dom";
import type { Edge, Graph, Node } from "./model";

export interface Text { x: number; y: number; words: string; style: "name" | "note" | "port" | "chip"; anchor: string }
export interface Place { x: number; y: number; width: number; height: number }
export interface End { id: string; node: number; side: "in" | "out"; port: number; x: number; y: number }
export interface Box extends Place { node: number; texts: Text[]; ends: End[]; chip?: Place }
export interface Frame extends Place { scope: string; folded: boolean; blocks: number }
export interface Line { edge: Edge; points: { x: number; y: number }[]; label?: Place; folded: boolean }
export interface Picture { width: number; height: number; boxes: Box[]; frames: Frame[]; lines: Line[]; down: boolean }

const ROW = 15, PAD = 9;
const FONTS = { name: "bold 13px", note: "italic 11px", port: "11px", chip: "11px" };
const elk = new ELK();

function width(words: string, style: keyof typeof FONTS): number {
  return textWidth(words, FONTS[style]);
}

/** The output that a box shows for a port: its name where there are several, else what it carries. */
function outWords(graph: Graph, node: Node, k: number): string {
  const port = node.outs[k];
  const type = cut(graph.types[port.type].words, 22);
  return node.outs.length > 1 && port.name ? `${port.name}: ${type}` : type;
}

/** A box as large as its texts need, with the places of its ports. */
function boxOf(graph: Graph, index: number, down: boolean): Box {
  const node = graph.nodes[index]!;
  const middle: { words: string; style: Text["style"] }[] = [{ words: node.name, style: "name" }];
  if (node.block) middle.push({ words: node.block, style: "note" });
  if (node.kind === "source") middle.push({ words: node.rate ?? "", style: "note" });
  if (node.at) middle.push({ words: cut(node.at, 34), style: "note" });
  if (node.kind === "host") middle.push({ words: "on the host", style: "note" });
  const chip = node.queue || (node.state && cut(`state, init ${node.state.initial}`, 34))
    || (node.kind === "register" && `${node.role}, init ${node.initial}`);
  if (chip) middle.push({ words: chip, style: "chip" });
  const ins = node.kind === "register" || node.kind === "output" || node.ins.length < 2
    ? node.ins.map(() => "") : node.ins.map((p) => p.name + (p.optional ? "?" : ""));
  const outs = node.kind === "block" || node.kind === "host" || node.kind === "source"
    ? node.outs.map((_, k) => outWords(graph, node, k)) : node.outs.map(() => "");
  const inner = Math.max(...middle.map((t) => width(t.words, t.style) + (t.style === "chip" ? 10 : 0)));
  const side = (words: string[]) => Math.max(0, ...words.map((w) => (w ? width(w, "port") : 0)));
  const texts: Text[] = [], ends: End[] = [];
  const end = (sideOf: "in" | "out", port: number, x: number, y: number) =>
    ends.push({ id: `${index}.${sideOf}.${port}`, node: index, side: sideOf, port, x, y });
  let box: Place, top: number;
  if (down) {
    const cells = (words: string[]) => words.reduce((sum, w) => sum + (w ? width(w, "port") : 0) + 14, 0);
    const w = Math.max(inner, cells(ins), cells(outs)) + 2 * PAD;
    top = ins.some(Boolean) ? ROW + 4 : 4;
    const h = top + middle.length * ROW + (outs.some(Boolean) ? ROW + 4 : 0) + 6;
    const point = node.kind === "source" ? 8 : 0; // below the text
    box = { x: 0, y: 0, width: w, height: h + point };
    const row = (words: string[], sideOf: "in" | "out", y: number) => {
      const room = (w - 2 * PAD) / Math.max(words.length, 1);
      const even = words.every((word) => width(word, "port") + 8 <= room);
      let x = w / 2 - cells(words) / 2;
      words.forEach((word, k) => {
        const wide = even ? room : width(word, "port") + 14;
        if (even && k === 0) x = PAD;
        end(sideOf, k, x + wide / 2, y);
        if (word) texts.push({ x: x + wide / 2, y: sideOf === "in" ? 14 : h - 6, words: word, style: "port", anchor: "middle" });
        x += wide;
      });
    };
    row(ins, "in", 0);
    row(outs, "out", h + point);
  } else {
    const left = side(ins), right = side(outs);
    const rows = Math.max(ins.length, outs.length, middle.length);
    const w = inner + 2 * PAD + (left ? left + 12 : 0) + (right ? right + 12 : 0);
    const h = rows * ROW + 10;
    box = { x: 0, y: 0, width: w, height: h };
    top = (h - middle.length * ROW) / 2;
    const column = (words: string[], sideOf: "in" | "out") => words.forEach((word, k) => {
      const y = h / 2 + (k - (words.length - 1) / 2) * ROW;
      end(sideOf, k, sideOf === "in" ? 0 : w, y);
      if (word) {
        texts.push({ x: sideOf === "in" ? 6 : w - 6, y: y + 4, words: word, style: "port", anchor: sideOf === "in" ? "start" : "end" });
      }
    });
    column(ins, "in");
    column(outs, "out");
    middle.forEach((t, k) => texts.push({ ...t, x: PAD + (left ? left + 12 : 0) + inner / 2, y: top + k * ROW + 12, anchor: "middle" }));
  }
  if (down) middle.forEach((t, k) => texts.push({ ...t, x: box.width / 2, y: top + k * ROW + 12, anchor: "middle" }));
  const made: Box = { ...box, node: index, texts, ends };
  const at = texts.find((t) => t.style === "chip");
  if (at) {
    const wide = width(at.words, "chip") + 8;
    made.chip = { x: at.x - wide / 2, y: at.y - 11, width: wide, height: 14 };
  }
  return made;
}

/** The outermost folded graph around a path, or nothing. */
export function foldedAround(graph: Graph, folded: Set<string>, path: string): string | undefined {
  return graph.scopes.filter((s) => folded.has(s.path) && path.startsWith(s.path + "/"))
    .sort((a, b) => a.path.length - b.path.length)[0]?.path;
}

/** The wires into delays that close a loop: laid out from the delay, so that all else flows one way. */
function returning(graph: Graph): Set<Edge> {
  const heads = new Map<number, number[]>();
  for (const edge of graph.edges) heads.set(edge.from, [...(heads.get(edge.from) ?? []), edge.to]);
  const closes = (edge: Edge): boolean => {
    const reached = new Set([edge.to]), rest = [edge.to];
    while (rest.length) {
      for (const next of heads.get(rest.pop()!) ?? []) {
        if (!reached.has(next)) {
          reached.add(next);
          rest.push(next);
        }
      }
    }
    return reached.has(edge.from);
  };
  return new Set(graph.edges.filter((edge) => edge.feedback && closes(edge)));
}

/** Lay the graph out as it is folded; `labels` is the room on each wire for what it carries, in pixels. */
export async function layOut(graph: Graph, folded: Set<string>, down: boolean, labels = 0): Promise<Picture> {
  const boxes = new Map<number, Box>();
  const nodes = new Map<string, ElkNode>();
  const children = new Map<string, ElkNode[]>([["", []]]);
  const sides = down ? ["NORTH", "SOUTH"] : ["WEST", "EAST"];
  const shown = graph.scopes.filter((s) => foldedAround(graph, folded, s.path) === undefined);
  const words = (path: string) => graph.scopes.find((s) => s.path === path)!.name;
  const inside = (path: string) => graph.nodes.filter((n) => n?.path.startsWith(path + "/") && n.block !== undefined).length;
  for (const scope of shown) {
    const made: ElkNode = { id: `scope ${scope.path}`, children: [], ports: [] };
    if (folded.has(scope.path)) {
      made.width = Math.max(width(words(scope.path), "name"), 76) + 40;
      made.height = 46;
      made.layoutOptions = { "elk.portConstraints": "FIXED_SIDE" };
    } else {
      made.layoutOptions = { "elk.padding": "[top=30,left=14,bottom=14,right=14]" };
      children.set(scope.path, made.children!);
    }
    nodes.set(scope.path, made);
  }
  for (const scope of shown) children.get(scope.parent)!.push(nodes.get(scope.path)!);
  graph.nodes.forEach((node, index) => {
    if (!node || foldedAround(graph, folded, node.path) !== undefined) return;
    const box = boxOf(graph, index, down);
    boxes.set(index, box);
    children.get(node.scope)!.push({
      id: `node ${index}`, width: box.width, height: box.height,
      layoutOptions: { "elk.portConstraints": "FIXED_POS" },
      ports: box.ends.map((e) => ({
        id: e.id, x: e.x, y: e.y, width: 0, height: 0,
        layoutOptions: { "elk.port.side": sides[e.side === "in" ? 0 : 1] },
      })),
    });
  });
  const lines: { edge: Edge; id: string; folded: boolean }[] = [], edges: ElkExtendedEdge[] = [];
  const known = new Set<string>(), labelled = new Set<string>();
  const portOf = (path: string, key: string, out: boolean): string => {
    const id = `${out ? "from" : "to"} ${path} ${key}`;
    const box = nodes.get(path)!;
    if (!box.ports!.some((p) => p.id === id)) {
      box.ports!.push({ id, width: 0, height: 0, layoutOptions: { "elk.port.side": sides[out ? 1 : 0] } });
    }
    return id;
  };
  const back = returning(graph);
  graph.edges.forEach((edge, k) => {
    const tail = graph.nodes[edge.from]!, head = graph.nodes[edge.to]!;
    const a = foldedAround(graph, folded, tail.path), b = foldedAround(graph, folded, head.path);
    if (a !== undefined && a === b) return;
    const key = `${edge.from}.${edge.out ?? 0}`;
    const target = head.kind === "block" || head.kind === "host" ? head.ins.findIndex((p) => p.name === edge.port) : 0;
    const once = b !== undefined ? `${key} ${b}` : String(k);
    if (known.has(once)) return;
    known.add(once);
    const begin = a !== undefined ? portOf(a, key, true) : `${edge.from}.out.${edge.out ?? 0}`;
    const end = b !== undefined ? portOf(b, key, false) : target < 0 ? `node ${edge.to}` : `${edge.to}.in.${target}`;
    const [source, sink] = back.has(edge) ? [end, begin] : [begin, end];
    const made: ElkExtendedEdge = { id: `edge ${k}`, sources: [source], targets: [sink] };
    if (labels && !edge.fires && !labelled.has(`${a}${key}`)) {
      labelled.add(`${a}${key}`);
      made.labels = [{ id: `label ${k}`, text: " ", width: labels, height: 13 }];
    }
    edges.push(made);
    lines.push({ edge, id: made.id, folded: a !== undefined || b !== undefined });
  });
  const laid: ElkNode = await elk.layout({
    id: "root", children: children.get(""), edges,
    layoutOptions: {
      "elk.algorithm": "layered", "elk.direction": down ? "DOWN" : "RIGHT",
      "elk.hierarchyHandling": "INCLUDE_CHILDREN", "elk.json.edgeCoords": "ROOT", "elk.json.shapeCoords": "ROOT",
      "elk.edgeRouting": "ORTHOGONAL", "elk.layered.feedbackEdges": "true",
      "elk.layered.spacing.nodeNodeBetweenLayers": down ? "26" : "34", "elk.spacing.nodeNode": "20",
      "elk.layered.spacing.edgeNodeBetweenLayers": "12", "elk.spacing.edgeNode": "12", "elk.spacing.edgeEdge": "8",
      "elk.layered.spacing.edgeEdgeBetweenLayers": "8", "elk.edgeLabels.placement": "TAIL",
      "elk.layered.nodePlacement.strategy": "NETWORK_SIMPLEX", "elk.layered.considerModelOrder.strategy": "NODES_AND_EDGES",
    },
  });
  const frames: Frame[] = [];
  const walk = (node: ElkNode) => {
    for (const child of node.children ?? []) {
      const place = { x: child.x!, y: child.y!, width: child.width!, height: child.height! };
      if (child.id.startsWith("node ")) Object.assign(boxes.get(Number(child.id.slice(5)))!, place);
      else {
        const scope = child.id.slice(6);
        frames.push({ ...place, scope, folded: folded.has(scope), blocks: inside(scope) });
        walk(child);
      }
    }
  };
  walk(laid);
  const routed = new Map((laid.edges ?? []).map((e) => [e.id, e]));
  return {
    width: laid.width!, height: laid.height!, boxes: [...boxes.values()], frames, down,
    lines: lines.map((line) => {
      const found = routed.get(line.id)!, section = found.sections![0];
      const label = found.labels?.[0];
      const points = [section.startPoint, ...(section.bendPoints ?? []), section.endPoint];
      return {
        edge: line.edge, folded: line.folded, points: back.has(line.edge) ? points.reverse() : points,
        label: label && { x: label.x!, y: label.y!, width: label.width!, height: label.height! },
      };
    }),
  };
}
