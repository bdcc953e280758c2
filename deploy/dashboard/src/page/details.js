// Shows the details of one run, and compares configurations.

import { Plot } from "./charts.js";
import { getJson } from "./data.js";
import { bytes, count, duration, element, figure, fill, share } from "./format.js";

const get = (id) => document.getElementById(id);
/** Palette of Okabe and Ito, used for joints. */
const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
  "#968c00"];
const STATES = { starting: "starting", running: "running", restarting: "waiting for restart",
  gone: "not running" };
const ACTIVITIES = { attaching: "waiting for a learner", stepping: "stepping environments",
  waiting: "waiting, queue full" };

const quoted = (text) => (/^[\w./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** The section of the page about one run. */
export class Details {
  constructor() {
    this.run = null;
    this.path = "";
    this.plot = null;
    this.cpu = new Map();
    for (const radio of document.getElementsByName("motion")) {
      radio.addEventListener("change", () => this.drawMotion());
    }
  }

  /** Shows a run, or updates the parts that have changed. */
  async update(run, path) {
    const isOther = this.run?.name !== run.name;
    const hasChanged = isOther || this.run.return_mean !== run.return_mean
      || run.env_steps !== this.run.env_steps;
    [this.run, this.path] = [run, path];
    if (isOther) this.cpu.clear();
    const parts = [this.workers()];
    if (hasChanged) parts.push(this.evaluations(), this.motion(), this.videos());
    await Promise.all(parts);
  }

  /** Requests data of the run; null if the user has selected another run meanwhile. */
  async request(part) {
    const { name } = this.run;
    const content = await getJson(`/api/${part}`, { run: name });
    return this.run.name === name ? { content } : null;
  }

  async workers() {
    const response = await this.request("processes");
    if (!response) return;
    const { state, session } = response.content;
    const note = get("workers-note");
    if (!session) {
      note.textContent = "This run was trained by an older version, which did not record processes.";
      get("workers").replaceChildren();
      return;
    }
    const age = duration(session.session_s);
    if (state === "training") note.textContent = `The session started ${age} ago.`;
    else if (session.ended) note.textContent = `The last session ended after ${age}.`;
    else note.textContent = `The last session was killed after ${age}. Its last known state:`;
    const heads = [["Process", false], ["State", false], ["Last heartbeat", false],
      ["Queued segments", true], ["Acknowledged", true], ["Starts", true], ["Cores used", true],
      ["Memory", true], ["Uptime", true]];
    fill(get("workers"), heads, session.processes.map((one) => this.processRow(one)));
  }

  processRow(one) {
    const worker = one.name.startsWith("actor");
    const wasRestarted = one.state === "restarting" || one.starts > 1;
    const heartbeat = one.silent_s === null ? "–"
      : [ACTIVITIES[one.doing], `${duration(one.silent_s)} ago`].filter(Boolean).join(", ");
    return [
      element("th", { scope: "row" }, one.joined ? `${one.name} (joined)` : one.name),
      element("td", { className: one.state === "restarting" ? "bad" : "" }, STATES[one.state]),
      worker ? heartbeat : "–",
      worker ? count(one.kept_segments) : "–",
      worker ? count(one.acknowledged_segments) : "–",
      element("td", { className: wasRestarted ? "number bad" : "number" }, count(one.starts)),
      figure(this.cores(one)),
      bytes(one.memory_bytes),
      duration(one.up_s),
    ];
  }

  /** Returns the processor time per second since the last update, or first since the start. */
  cores({ name, cpu_s, up_s }) {
    if (cpu_s === null || !up_s) return null;
    const last = this.cpu.get(name);
    const same = last && up_s > last.up_s;
    if (!same || up_s - last.up_s > 1) this.cpu.set(name, { cpu_s, up_s, cores: last?.cores });
    const cores = same && up_s - last.up_s > 1 ? (cpu_s - last.cpu_s) / (up_s - last.up_s)
      : last?.cores ?? cpu_s / up_s;
    this.cpu.get(name).cores = cores;
    return Math.round(cores * 100) / 100;
  }

  async evaluations() {
    const response = await this.request("evaluations");
    if (!response) return;
    const { first_seed, count: all, rows } = response.content;
    const note = get("evaluations-note");
    const table = get("evaluations");
    if (!rows.length) {
      note.textContent = "No evaluations yet.";
      table.replaceChildren();
      return;
    }
    note.textContent = `Episode i is reset with seed ${first_seed} + i. `
      + (all > rows.length ? `Showing the newest ${rows.length} of ${count(all)}.` : "");
    // As `--policy best`: the highest success rate, and of equal ones the highest return.
    const rank = (row, other) => (row.success_rate ?? 0) - (other.success_rate ?? 0)
      || row.return_mean - other.return_mean;
    const best = rows.reduce((one, other) => (rank(other, one) >= 0 ? other : one));
    const heads = [["Steps", true], ["Time", true], ["Policy", true], ["Return", true],
      ["Lowest", true], ["Highest", true], ["Success", true], ["Smoothness", true],
      ["Return of each episode", false]];
    fill(table, heads, rows.map((row) => [
      count(row.env_steps), duration(row.wall_s), count(row.policy_version),
      element("td", { className: rank(row, best) === 0 ? "number differs" : "number" },
        figure(row.return_mean)),
      figure(Math.min(...row.returns)), figure(Math.max(...row.returns)),
      share(row.success_rate), figure(row.smoothness),
      row.returns.slice(0, 10).map((value) => figure(value)).join(", ")
        + (row.returns.length > 10 ? ", …" : ""),
    ]));
  }

  async motion() {
    const response = await this.request("motion");
    if (!response) return;
    this.episode = response.content;
    get("motion-kinds").hidden = !this.episode;
    if (!this.episode) {
      get("motion-note").replaceChildren("Not measured yet. To roll out the latest policy, run ",
        element("code", {}, `dmprl report ${quoted(this.path)}`));
      this.plot?.destroy();
      get("motion").replaceChildren();
      return;
    }
    const { episode } = this;
    const success = { true: ", success", false: ", no success" }[episode.success] ?? "";
    get("motion-note").textContent = `Policy ${count(episode.policy_version)} `
      + `(${count(episode.env_steps)} steps), seed ${episode.seed}: return `
      + `${figure(episode.return)}${success}. Mean joint jerk ${figure(episode.joint_jerk)} `
      + `${episode.unit}/s³, spectral arc length ${figure(episode.sparc)}. ${episode.why_no_joints}`;
    this.drawMotion();
  }

  drawMotion() {
    const { episode } = this;
    if (!episode) return;
    const kind = document.querySelector("input[name=motion]:checked").value;
    const units = [...new Set(episode.joints.map((joint) => joint.unit))].join(", ");
    const unit = { positions: `[${units}]`, velocities: `[${units} per second]`,
      actions: "scaled to [−1, 1]" }[kind];
    const columns = episode[kind];
    const names = kind === "actions" ? columns.map((_, index) => `action ${index + 1}`)
      : episode.joints.map((joint) => joint.name);
    this.plot?.destroy();
    this.plot = new Plot(`Joint ${kind}`.replace("Joint actions", "Actions"), unit);
    get("motion").replaceChildren(this.plot.figure);
    const lines = columns.map((y, index) => ({
      label: names[index], x: episode.times.slice(0, y.length), y,
      style: { colour: PALETTE[index % 8], dash: index < 8 ? [] : [8, 4] },
    }));
    if (lines.length) this.plot.draw(lines, { axis: episode.in_seconds ? "time [s]" : "steps" });
  }

  async videos() {
    const response = await this.request("videos");
    if (!response) return;
    const { videos } = response.content;
    const parent = get("videos");
    const key = JSON.stringify([this.run.name, videos]);
    // Drawing the same videos again would restart a playing one.
    if (parent.dataset.key === key) return;
    parent.dataset.key = key;
    const films = videos.filter((one) => one.name.endsWith(".mp4"));
    const shown = (films.length ? films : videos).slice(-6).reverse();
    get("videos-note").replaceChildren(...(shown.length ? [] : ["No videos yet. To record one, run ",
      element("code", {}, `dmprl record ${quoted(this.path)}`)]));
    parent.replaceChildren(...shown.map((one) => {
      const source = `/video?${new URLSearchParams({ run: this.run.name, name: one.name })}`;
      const title = one.name.replace(/\.\w+$/, "");
      const picture = one.name.endsWith(".mp4")
        ? element("video", { src: source, controls: true, loop: true, preload: "none", width: 480 })
        : element("img", { src: source, alt: title, loading: "lazy" });
      picture.setAttribute("aria-label", title);
      if (picture.preload) onceNear(picture, () => { picture.preload = "metadata"; });
      return element("figure", {}, picture, element("figcaption", {}, title));
    }));
  }
}

/** Calls `callback` once, when an element gets near the visible part of the page. */
function onceNear(target, callback) {
  const observer = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    callback();
  }, { rootMargin: "300px" });
  observer.observe(target);
}

/** The table that compares configurations. */
export class Configuration {
  constructor() {
    this.known = new Map();
    this.runs = [];
    this.drawn = "";
    get("all-keys").addEventListener("change", () => this.draw());
    get("key-filter").addEventListener("input", () => this.draw());
  }

  async update(runs) {
    this.runs = runs;
    await Promise.all(runs.filter((run) => this.known.get(run.name)?.steps !== run.steps)
      .map(async (run) => {
        const { keys } = await getJson("/api/config", { run: run.name });
        this.known.set(run.name, { steps: run.steps, keys });
      }));
    const content = JSON.stringify(runs.map((run) => [run.name, run.label, run.steps]));
    if (content === this.drawn) return;
    this.drawn = content;
    this.draw();
  }

  draw() {
    const runs = this.runs.filter((run) => this.known.has(run.name));
    get("configuration").hidden = runs.length === 0;
    if (!runs.length) return;
    const values = (key) => runs.map((run) => this.known.get(run.name).keys[key] ?? "–");
    const keys = [...new Set(runs.flatMap((run) => Object.keys(this.known.get(run.name).keys)))];
    const differs = (key) => new Set(values(key)).size > 1;
    const different = keys.filter(differs);
    const all = get("all-keys").checked || runs.length < 2;
    get("all-keys").disabled = runs.length < 2;
    const wanted = get("key-filter").value.trim().toLowerCase();
    const shown = (all ? keys : different).filter((key) => key.toLowerCase().includes(wanted));
    get("configuration-note").textContent = runs.length < 2
      ? `All ${keys.length} keys of ${runs[0].label}. Select a second run to compare them.`
      : `${different.length} of ${keys.length} keys differ between these ${runs.length} runs.`;
    fill(get("keys"), [["Key", false], ...runs.map((run) => [run.label, false])],
      shown.map((key) => [element("th", { scope: "row" }, key), ...values(key).map((value) =>
        element("td", { className: runs.length > 1 && differs(key) ? "differs" : "" }, value))]));
  }
}
