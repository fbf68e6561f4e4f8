// Bundles src/ into the folder that is named: what a page needs, in one script each, and the licences of what is
// in them. Run by `make front`, in a copy of this folder with its node_modules.
import { build } from "esbuild";
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";

const out = process.argv[2];
const used = { diagram: ["elkjs"], run: ["uplot", "three"], live: ["uplot"], report: ["uplot"] };
for (const name of Object.keys(used)) {
  await build({
    entryPoints: [`src/${name}_page.ts`],
    outfile: join(out, `${name}.js`),
    bundle: true, minify: true, format: "iife", target: "es2023", charset: "ascii", legalComments: "none",
    // elkjs asks for a worker of node's, which no page has.
    external: ["web-worker"],
    logLevel: "warning",
  });
}
await build({ entryPoints: ["src/style.css"], outfile: join(out, "style.css"), bundle: true, minify: true });

const files = { elkjs: "LICENSE.md", uplot: "LICENSE", three: "LICENSE" };
const notices = [...new Set(Object.values(used).flat())].map((name) => {
  const about = JSON.parse(readFileSync(join("node_modules", name, "package.json"), "utf8"));
  const source = (about.repository?.url ?? about.repository).replace(/^git\+/, "").replace(/\.git$/, "");
  const licence = readFileSync(join("node_modules", name, files[name]), "utf8").trim();
  return `${name} ${about.version}, ${about.license}, unchanged; its source: ${source}\n\n${licence}\n`;
});
const rule = "\n" + "-".repeat(78) + "\n\n";
const head = "The scripts of this folder are made of flowgraph's own, in ../front, and of these libraries.\n";
writeFileSync(join(out, "NOTICES.txt"), [head, ...notices].join(rule));
