// Formats numbers and times, and creates elements.

/** Creates an element with properties and children. Text is never parsed as HTML. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

const small = new Intl.NumberFormat("en", { maximumSignificantDigits: 4 });
const whole = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const short = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 4 });

/** Formats a number with about four significant digits; a dash if there is none. */
export function figure(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return Number.isInteger(value) || size >= 1000 ? whole.format(value) : small.format(value);
}

/** Formats a count for an axis: 20k, 1.5M. */
export const compact = (value) => short.format(value).toLowerCase().replace("m", "M");

/** Formats a count with all digits. */
export const count = (value) => (value === null || value === undefined ? "–" : whole.format(value));

/** Formats a fraction as a percentage. */
export const share = (value) => (value === null || value === undefined ? "–"
  : `${small.format(100 * value)}\u00a0%`);

/** Formats a duration: 42 s, 12 min, 3.5 h. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  if (seconds < 120) return `${small.format(Math.round(seconds * 10) / 10)}\u00a0s`;
  if (seconds < 7200) return `${small.format(Math.round(seconds / 6) / 10)}\u00a0min`;
  return `${small.format(Math.round(seconds / 360) / 10)}\u00a0h`;
}

/** Formats bytes as MiB or GiB. */
export function bytes(value) {
  if (value === null || value === undefined) return "–";
  const mebi = value / 1048576;
  return mebi < 1024 ? `${small.format(mebi)}\u00a0MiB` : `${small.format(mebi / 1024)}\u00a0GiB`;
}

/** Creates a sample of a run's line style. */
export function swatch(colour, dash) {
  const space = "http://www.w3.org/2000/svg";
  const picture = document.createElementNS(space, "svg");
  picture.setAttribute("class", "swatch");
  picture.setAttribute("viewBox", "0 0 26 10");
  picture.setAttribute("aria-hidden", "true");
  const line = document.createElementNS(space, "line");
  const attributes = { x1: 0, y1: 5, x2: 26, y2: 5, stroke: colour, "stroke-width": 3 };
  if (dash.length) attributes["stroke-dasharray"] = dash.join(" ");
  for (const [name, value] of Object.entries(attributes)) line.setAttribute(name, value);
  picture.append(line);
  return picture;
}

/** Fills a table. Heads are [text, isNumber]; rows are lists of texts or elements. */
export function fill(table, heads, rows) {
  const head = element("thead", {}, element("tr", {}, ...heads.map(([text, isNumber]) =>
    element("th", { scope: "col", className: isNumber ? "number" : "" }, text))));
  const cell = (value, index) => (value instanceof Element ? value
    : element("td", { className: heads[index][1] ? "number" : "" }, value));
  const body = element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map(cell))));
  table.replaceChildren(head, body);
}
