// Elements, made without HTML: whatever a graph's author wrote is text.

type Attributes = Record<string, string | number | boolean | undefined>;
type Child = Node | string | null | undefined | false;

function fill(element: Element, attributes: Attributes, children: Child[]): void {
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== undefined && value !== false) element.setAttribute(key, value === true ? "" : String(value));
  }
  for (const child of children) if (child) element.append(child);
}

export function html<K extends keyof HTMLElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  fill(element, attributes, children);
  return element;
}

export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: Child[]
): SVGElementTagNameMap[K] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  fill(element, attributes, children);
  return element;
}

/** A button that says what it does to a reader and to a screen reader: a word is its own name, a sign is none. */
export function button(label: string, title: string, act: () => void): HTMLButtonElement {
  const made = html("button", { type: "button", title, "aria-label": /[a-z]/i.test(label) ? undefined : title }, label);
  made.addEventListener("click", act);
  return made;
}

const canvas = document.createElement("canvas").getContext("2d")!;
export const FONT = "system-ui, sans-serif";

/** The width of a text in pixels; `style` is such as "bold 12px". */
export function textWidth(text: string, style: string): number {
  canvas.font = `${style} ${FONT}`;
  return Math.ceil(canvas.measureText(text).width);
}

export function cut(text: string, most: number): string {
  return text.length <= most ? text : text.slice(0, most - 1).trimEnd() + "…";
}

/** Follow what the person has asked of the system, until they choose another look here. */
export function themeButton(): HTMLButtonElement {
  return button("◐", "Dark or light", () => {
    const chosen = document.documentElement.dataset.theme;
    const dark = chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = dark ? "light" : "dark";
    document.dispatchEvent(new Event("theme"));
  });
}
