// What a page is given, as drawing/model.py and drawing/scopes.py write it.

export interface Leaf { name: string; shape: number[]; dtype: string; unit: string; frame: string }
export interface Type { words: string; leaves: Leaf[] }
export interface Clock { words: string; rate: string }
export interface Port {
  name: string; type: number; clock: number | null; when?: string; optional?: boolean; held?: string;
}
export type Pair = [string, string];
export interface Memory { type: number; initial: string; initially: Pair[]; costs?: Record<string, unknown> }
export interface Node {
  kind: "source" | "block" | "host" | "register" | "output";
  path: string; name: string; scope: string; ins: Port[]; outs: Port[];
  block?: string; doc?: string; source?: string; settings?: Pair[]; fires?: string; at?: string; queue?: string;
  state?: Memory; rate?: string; role?: string; initial?: string; initially?: Pair[];
  costs?: Record<string, unknown>;
}
export interface Edge {
  from: number; out: number | null; to: number; port: string; optional: boolean; feedback: boolean; fires: boolean;
}
export interface Scope { path: string; name: string; parent: string }
export interface Graph {
  name: string; doc: string; settings: Pair[]; scopes: Scope[]; types: Type[]; clocks: Clock[];
  nodes: (Node | null)[]; edges: Edge[]; costs: Record<string, unknown>;
}

/** Numbers as they stand in the page: base64 of float32, little-endian. */
export type Packed = string;

export function unpack(packed: Packed): Float32Array {
  const bytes = Uint8Array.from(atob(packed), (c) => c.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

/** The page's own data, which stand in it as text. */
export function given<T>(id: string): T {
  return JSON.parse(document.getElementById(id)!.textContent!) as T;
}

export interface Dots { name: string; t: Packed; y: Packed }
export interface Panel {
  group: string; title: string; unit: string; dots: boolean; t: number; lines: { name: string; y: Packed }[];
  sigma: Packed | null; range: [number, number]; whole?: [number, number] | null; words?: string;
  bounds?: [number, number]; wrong?: boolean; points?: Dots[];
}
export interface Part { name: string; way: "whole" | "deviation" | "range"; size: number; unit: string }
export interface Cloud { name: string; times: Packed; size: number; of: number; places: Packed }
export interface Watch {
  times: Packed; stride: number; wires: Record<string, { at: Packed; values: Packed; parts: Part[] }>; cloud?: Cloud;
}
export interface Way {
  t: Packed; estimate: Packed; attitude: Packed | null; truth: Packed | null; unit: string;
  seen: { name: string; gnss: boolean; t: Packed; places: Packed }[];
}
export interface Run {
  title: string; graph: Graph; engine: string; ticks: number; end: number; figures: Pair[]; notes: string[];
  times: Packed[]; panels: Panel[]; watch: Watch | null; blocks: Record<string, [number, number]>; way: Way | null;
}

export interface Axis { label: string; log?: boolean; names?: string[] | null }
export interface ChartSeries {
  name: string; kind: "box" | "bar" | "dots" | "line" | "dash"; x: number[]; y: number[]; width?: number;
  low?: number[] | null; high?: number[] | null; boxes?: number[][]; words?: string[]; runs?: (number | null)[];
  dots?: { x: number; y: number; words: string; run: number | null }[];
}
export interface Mark { name: string; x?: number; y?: number; from?: number; to?: number }
export interface Chart { title: string; words: string; x: Axis; y: Axis; series: ChartSeries[]; marks: Mark[] }
