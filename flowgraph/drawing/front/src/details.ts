// What is to be known of one block, register or source, or of the graph where none is chosen.

import { html } from "./dom";
import type { Diagram } from "./diagram";
import type { Memory, Node, Pair } from "./model";

function table(title: string, rows: Pair[]): HTMLElement | null {
  if (!rows.length) return null;
  return html("section", {}, html("h3", {}, title),
    html("table", {}, html("tbody", {}, ...rows.map(([name, words]) => html("tr", {}, html("th", { scope: "row" }, name), html("td", {}, words))))));
}

function prose(words: string): HTMLElement | null {
  if (!words) return null;
  const parts = words.split(/\n\s*\n/).map((part) => {
    const kept = /^\s+\S/m.test(part); // equations and lists of arguments are set off by spaces
    return html("p", { class: kept ? "kept" : undefined }, kept ? part : part.replaceAll("\n", " "));
  });
  return html("div", { class: "doc" }, ...parts);
}

/** The paragraph of a docstring that names where its equations are from. */
function reference(words: string): string {
  return words.split(/\n\s*\n/).find((part) => /^\s*(Source|Reference)s?\s*:/.test(part))?.trim() ?? "";
}

function number(value: unknown): string {
  return typeof value === "number" ? value.toLocaleString("en-US").replaceAll(",", " ") : String(value);
}

function costs(of: Record<string, unknown> | undefined): HTMLElement | null {
  return of ? table("As lowered", Object.entries(of).map(([name, value]): Pair => [name, number(value)])) : null;
}

function memory(diagram: Diagram, of: Memory): HTMLElement | null {
  return html("div", {}, table("Remembers", [["type", diagram.graph.types[of.type].words]]), table("Starts at", of.initially), costs(of.costs));
}

export function details(diagram: Diagram, more: (node: number | undefined) => (HTMLElement | null)[] = () => []): HTMLElement {
  const { graph } = diagram;
  const panel = html("aside", { class: "details", "aria-label": "Details", tabindex: "0" });
  const ports = (node: Node) => {
    const list = (title: string, side: "in" | "out") => {
      const ends = side === "in" ? node.ins : node.outs;
      if (!ends.length || node.kind === "register") return null;
      return html("section", {}, html("h3", {}, title), ...ends.map((port) => {
        const [first, ...rest] = diagram.portWords(node, port, side);
        return html("div", { class: "end", style: `--colour: ${diagram.colour(port.clock)}` },
          html("div", { class: "first" }, first.slice(node.path.length).replace(/^[.:]\s*/, "")), ...rest.map((line) => html("div", { class: "more" }, line.trim())));
      }));
    };
    return [list("Inputs", "in"), list(node.kind === "source" ? "Gives" : "Outputs", "out")];
  };
  const show = (index: number | undefined) => {
    const node = index === undefined ? undefined : graph.nodes[index];
    panel.scrollTop = 0;
    if (!node) {
      panel.replaceChildren(...[
        html("h2", {}, graph.name), prose(graph.doc), table("Settings", graph.settings), costs(Object.keys(graph.costs).length ? graph.costs : undefined),
        ...more(undefined),
        table("Keys", [["Tab", "to blocks and ports"], ["Enter", "details; folds and unfolds"], ["/", "search"], ["arrows", "move"], ["+ − 0", "zoom; all"]]),
      ].filter((part) => part !== null));
      return;
    }
    const kind = { source: "Source", block: "Block", host: "Block on the host", register: `Register, ${node.role}`, output: "Output" }[node.kind];
    const facts: Pair[] = [];
    if (node.block) facts.push(["block", node.block]);
    if (node.fires) facts.push(["fires at", node.fires]);
    if (node.rate) facts.push(["rate", node.rate]);
    if (node.queue) facts.push(["queues", node.queue.replace(/^queues /, "")]);
    if (node.source) facts.push(["written in", node.source]);
    const ref = reference(node.doc ?? "");
    if (ref) facts.push(["source", ref.replace(/^\w+\s*:\s*/, "")]);
    if (node.kind === "register") facts.push(["type", graph.types[node.outs[0].type].words]);
    panel.replaceChildren(...[
      html("h2", {}, node.path), html("p", { class: "kind" }, kind), table("About", facts), prose(node.doc ?? ""),
      table("Settings", node.settings ?? []), ...more(index), ...ports(node), node.state ? memory(diagram, node.state) : null,
      node.initially ? table("Starts at", node.initially) : null, costs(node.costs),
    ].filter((part) => part !== null));
  };
  diagram.onSelect = show;
  show(undefined);
  return panel;
}
