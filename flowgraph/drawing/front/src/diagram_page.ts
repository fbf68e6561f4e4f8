// The page of a graph. What is in it stands in window.flowgraph too, for the page of a run, which has it as a part.

import { details } from "./details";
import { Diagram, legend, tools } from "./diagram";
import * as dom from "./dom";
import { given, unpack, type Graph } from "./model";

const parts = { Diagram, legend, tools, details, dom, given, unpack };
export type Parts = typeof parts;
declare global {
  interface Window { flowgraph: Parts; diagram?: Diagram }
}
window.flowgraph = parts;

if (document.body.dataset.page === "diagram") {
  const graph = given<Graph>("graph");
  const main = document.querySelector("main")!;
  const sheet = dom.html("div", { class: "sheet" });
  const diagram = new Diagram(graph, sheet, given<{ down?: boolean; folded?: string[] }>("begin"));
  const bar = tools(diagram);
  bar.append(dom.themeButton());
  document.querySelector("header")!.append(bar);
  main.append(sheet, details(diagram));
  document.querySelector("footer")!.append(legend(diagram));
  window.diagram = diagram;
  void diagram.start();
}
