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
