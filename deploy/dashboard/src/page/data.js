// Caches the data of runs, and requests only additions.

/** Time limit of a request. */
const PATIENCE_MS = 15000;
/** Number of cached points beyond which a curve is fetched anew, with at most a thousand points. */
const POINTS_MAX = 4000;

/** Requests JSON; an error has the server's message. */
export async function ask(path, query = {}) {
  const text = new URLSearchParams(query).toString();
  const answer = await fetch(text ? `${path}?${text}` : path,
    { signal: AbortSignal.timeout(PATIENCE_MS) });
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error ?? answer.statusText);
  return content;
}

/** The growing curves of one file of one run. */
class Curves {
  constructor(run, file, names) {
    Object.assign(this, { run, file, names, table: 0, next: 0, mark: null });
    this.curves = new Map();
  }

  /** Requests new points; returns true if there were any. */
  async update() {
    const longest = Math.max(0, ...[...this.curves.values()].map((curve) => curve.values.length));
    if (longest > POINTS_MAX) this.table = 0;
    const query = { run: this.run, file: this.file, names: this.names.join(","),
      table: this.table, from: this.next };
    const answer = await ask("/api/curves", query);
    const anew = answer.table !== this.table;
    if (!anew && answer.next === this.next) return false;
    this.names.forEach((name, index) => {
      const more = answer.curves[index];
      const known = anew ? undefined : this.curves.get(name);
      if (!known) this.curves.set(name, more);
      else for (const key of Object.keys(more)) known[key].push(...more[key]);
    });
    [this.table, this.next] = [answer.table, answer.next];
    return true;
  }
}

/** The curves of all runs shown. */
export class Store {
  constructor(names) {
    this.names = names;
    this.runs = new Map();
  }

  /** Requests the new points of a run, if its entry in the list has changed. */
  async update(run) {
    const known = this.runs.get(run.name) ?? { mark: null, files: Object.keys(this.names).map(
      (file) => new Curves(run.name, file, this.names[file])) };
    this.runs.set(run.name, known);
    const mark = JSON.stringify([run.env_steps, run.wall_s, run.return_mean]);
    if (known.mark === mark && run.state !== "training") return false;
    const changed = await Promise.all(known.files.map((file) => file.update()));
    known.mark = mark;
    return changed.some(Boolean);
  }

  /** Drops runs that are no longer shown. */
  keep(names) {
    for (const name of this.runs.keys()) if (!names.includes(name)) this.runs.delete(name);
  }

  /** Returns a curve, or nothing if the run has no values for it. */
  curve(run, file, name) {
    const known = this.runs.get(run)?.files.find((one) => one.file === file);
    const curve = known?.curves.get(name);
    return curve?.values.length ? curve : null;
  }
}
