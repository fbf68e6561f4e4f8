// Finding and writing numbers.

/** The last index at which sorted times are not after t; -1 before the first. */
export function before(times: ArrayLike<number>, t: number): number {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** A number in few figures. */
export function short(x: number, figures = 4): string {
  if (!Number.isFinite(x)) return "–";
  const size = Math.abs(x);
  if (size !== 0 && (size < 1e-3 || size >= 10 ** (figures + 1))) return x.toExponential(figures - 2).replace("e+", "e");
  return x.toPrecision(figures).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, "");
}

const colours = new Map<string, string>();
const forget = () => {
  colours.clear();
  document.dispatchEvent(new Event("recolour"));
};
document.addEventListener("theme", forget);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", forget);

/** A colour of the look that is chosen, as canvas wants it. Who draws with it draws anew on "recolour". */
export function colour(name: string): string {
  let found = colours.get(name);
  if (found === undefined) {
    const probe = document.createElement("span");
    probe.style.color = `var(--${name})`;
    document.body.append(probe);
    found = getComputedStyle(probe).color;
    probe.remove();
    colours.set(name, found);
  }
  return found;
}
