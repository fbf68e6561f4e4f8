// The page of a report: its charts take the place of their pictures, its tables can be sorted, and the runs that are
// in it are picked and compared as on a page of their own.

import { ChartView } from "./charts";
import { html, themeButton } from "./dom";
import { given, type Chart, type Run } from "./model";

const main = document.querySelector("main")!;
const has = (id: string) => document.getElementById(id) !== null;
const runs = has("runs") ? given<Run[]>("runs") : [];
const place = document.querySelector<HTMLElement>("section.shown-runs");
const View = window.RunView;
const view = place && View && runs.length ? new View(runs, 0, (run) => { main.dataset.shown = String(run); }) : undefined;

/** A column is sorted by a click on its head: numbers by size, words by letters. */
function sortable(table: HTMLTableElement): void {
  const [head, ...rows] = [...table.rows];
  if (!head || rows.length < 2) return;
  [...head.cells].forEach((cell, column) => {
    const words = cell.textContent ?? "";
    const press = html("button", { type: "button", class: "sort" }, words);
    press.addEventListener("click", () => {
      const down = cell.getAttribute("aria-sort") === "ascending";
      for (const one of head.cells) one.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", down ? "descending" : "ascending");
      const of = (row: HTMLTableRowElement) => row.cells[column]?.textContent?.trim() ?? "";
      const sign = down ? -1 : 1, number = (words: string) => (words === "" ? NaN : Number(words));
      rows.sort((a, b) => {
        const [x, y] = [of(a), of(b)], [p, q] = [number(x), number(y)];
        if (!Number.isNaN(p) && !Number.isNaN(q)) return sign * (p - q);
        return Number(x === "") - Number(y === "") || sign * x.localeCompare(y);
      });
      for (const row of rows) row.parentElement!.append(row);
    });
    cell.replaceChildren(press);
  });
}

for (const table of main.querySelectorAll<HTMLTableElement>(".table table")) sortable(table);
for (const figure of main.querySelectorAll<HTMLElement>("figure[data-chart]")) {
  const chart = given<Chart[]>("charts")[Number(figure.dataset.chart)];
  const made = new ChartView(chart, (run) => {
    view?.pick(run, true);
    place?.scrollIntoView({ behavior: "smooth" });
  });
  figure.querySelector("img")?.classList.add("printed");
  figure.append(made.element);
}
document.querySelector("header")!.append(html("div", { class: "tools" }, themeButton()));
if (view && place) place.append(view.picks, view.element, view.bar);
main.dataset.charted = "";
