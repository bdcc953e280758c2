// Caches the curves of runs, and requests only new points.

/** Time limit of a request. */
const TIMEOUT_MS = 15000;
/** Number of cached points beyond which a curve is requested again as a whole. The server then
 * reduces it to about a thousand points. */
const POINTS_MAX = 4000;

/** Requests JSON. Errors have the server's message. */
export async function getJson(path, query = {}) {
  const text = new URLSearchParams(query).toString();
  const response = await fetch(text ? `${path}?${text}` : path,
    { signal: AbortSignal.timeout(TIMEOUT_MS) });
  const content = await response.json();
  if (!response.ok) throw new Error(content.error ?? response.statusText);
  return content;
}

/** The curves of one file of one run. */
class Curves {
  constructor(run, file, names) {
    Object.assign(this, { run, file, names, table: 0, next: 0 });
    this.curves = new Map();
  }

  /** Requests new points; returns true if there were any. */
  async update() {
    const longest = Math.max(0, ...[...this.curves.values()].map((curve) => curve.values.length));
    if (longest > POINTS_MAX) this.table = 0;
    const query = { run: this.run, file: this.file, names: this.names.join(","),
      table: this.table, from: this.next };
    const response = await getJson("/api/curves", query);
    const isWhole = response.table !== this.table;
    if (!isWhole && response.next === this.next) return false;
    this.names.forEach((name, index) => {
      const points = response.curves[index];
      const known = isWhole ? undefined : this.curves.get(name);
      if (!known) this.curves.set(name, points);
      else for (const key of Object.keys(points)) known[key].push(...points[key]);
    });
    [this.table, this.next] = [response.table, response.next];
    return true;
  }
}

/** The curves of all runs shown. */
export class Store {
  constructor(names) {
    this.names = names;
    this.runs = new Map();
  }

  /** Requests new points of a run if it is training or its entry in the list has changed. */
  async update(run) {
    const known = this.runs.get(run.name) ?? { stamp: null, files: Object.keys(this.names).map(
      (file) => new Curves(run.name, file, this.names[file])) };
    this.runs.set(run.name, known);
    const stamp = JSON.stringify([run.env_steps, run.wall_s, run.return_mean]);
    if (known.stamp === stamp && run.state !== "training") return false;
    const changed = await Promise.all(known.files.map((file) => file.update()));
    known.stamp = stamp;
    return changed.some(Boolean);
  }

  /** Drops all runs except those in `names`. */
  keep(names) {
    for (const name of this.runs.keys()) if (!names.includes(name)) this.runs.delete(name);
  }

  /** Returns a curve, or null if the run has no values for it. */
  curve(run, file, name) {
    const known = this.runs.get(run)?.files.find((one) => one.file === file);
    const curve = known?.curves.get(name);
    return curve?.values.length ? curve : null;
  }
}
