// What the page knows of runs, and how it asks for more: only for what is new.

/** A request that takes longer is given up. */
const PATIENCE_MS = 15000;
/** A curve with more new points than this is asked for anew: the server sends a thousand. */
const POINTS_MAX = 4000;

/** Asks for JSON; an error says what the server said. */
export async function ask(path, query = {}) {
  const text = new URLSearchParams(query).toString();
  const answer = await fetch(text ? `${path}?${text}` : path,
    { signal: AbortSignal.timeout(PATIENCE_MS) });
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error ?? answer.statusText);
  return content;
}

/** The curves of one file of one run, which grow. */
class Curves {
  constructor(run, file, names) {
    Object.assign(this, { run, file, names, table: 0, next: 0, mark: null });
    this.curves = new Map();
  }

  /** Asks for what is new; true if there was anything. */
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

/** The curves of every run that was shown. */
export class Store {
  constructor(names) {
    this.names = names;
    this.runs = new Map();
  }

  /** Asks for what is new of a run, if its entry in the list says that there is something. */
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

  /** Forgets runs that are not shown any more. */
  keep(names) {
    for (const name of this.runs.keys()) if (!names.includes(name)) this.runs.delete(name);
  }

  /** A curve, none if the run has no value of it. */
  curve(run, file, name) {
    const known = this.runs.get(run)?.files.find((one) => one.file === file);
    const curve = known?.curves.get(name);
    return curve?.values.length ? curve : null;
  }
}
