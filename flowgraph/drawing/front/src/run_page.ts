// The page of runs. Its view stands in window.flowgraph too, for a report, which has it as a part.

import type { Run } from "./model";
import { RunView } from "./run_view";

const { dom, given } = window.flowgraph;
declare global {
  interface Window { RunView?: typeof RunView }
}
window.RunView = RunView;

if (document.body.dataset.page === "run") {
  const main = document.querySelector("main")!, header = document.querySelector("header")!;
  const runs = given<Run[]>("runs");
  const time = Number(/[#&]t=([\d.]+)/.exec(location.hash)?.[1] ?? 0); // a link may name the time: run.html#t=2.5
  const view = new RunView(runs, time, (run) => { main.dataset.shown = String(run); });
  header.querySelector("p")!.hidden = runs.length > 1;
  view.picks.append(dom.themeButton());
  header.append(view.picks);
  main.append(view.element);
  document.querySelector("footer")!.append(view.bar);
}
