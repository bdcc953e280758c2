// The page: selects the runs to show, and refreshes them.

import { Charts, names, styles } from "./charts.js";
import { ask, Store } from "./data.js";
import { Configuration, Details } from "./details.js";
import { count, duration, element, figure, share, swatch } from "./format.js";

/** Interval between two refreshes, during training and otherwise. A refresh takes some hundredths
 * of a second of processor time, which training may need. */
const LOOK_MS = { training: 4000, still: 6000 };
/** Maximum number of runs drawn at once: more lines are indistinguishable. */
const SHOWN_MAX = 12;
/** Number of runs shown initially. */
const SHOWN_FIRST = 4;
const STATES = { training: "training", finished: "finished", stopped: "stopped" };

const get = (id) => document.getElementById(id);
const store = new Store(names());
const charts = new Charts(get("curves"));
const details = new Details();
const configuration = new Configuration();

/** The settings after # in the address, so that a view can be bookmarked and shared. */
const chosen = readAddress();
let listed = [];
let root = "";
let leftOut = 0;
/** Content already shown, which is not drawn again. */
const drawn = { list: "", labels: "" };
let timer = 0;
let looking = false;
let again = false;
/** While a button is pressed the list is not redrawn; otherwise a click would miss its entry. */
let pressed = false;

function readAddress() {
  const said = new URLSearchParams(location.hash.slice(1));
  return {
    runs: said.has("run") || said.has("none") ? said.getAll("run") : null,
    details: said.get("details"),
    axis: said.get("axis") === "wall_s" ? "wall_s" : "env_steps",
    weight: Math.min(0.95, Math.max(0, Number(said.get("smoothing")) || 0)),
    log: said.has("log"),
  };
}

function writeAddress() {
  const says = new URLSearchParams();
  (chosen.runs ?? []).forEach((run) => says.append("run", run));
  if (chosen.runs?.length === 0) says.set("none", "");
  if (chosen.details) says.set("details", chosen.details);
  if (chosen.axis !== "env_steps") says.set("axis", chosen.axis);
  if (chosen.weight > 0) says.set("smoothing", chosen.weight);
  if (chosen.log) says.set("log", "");
  history.replaceState(null, "", `#${says}`);
}

/** Chooses the runs shown initially: those being trained, or else the newest. */
function firstChoice() {
  const newest = [...listed].filter((run) => !run.fault)
    .sort((a, b) => b.started.localeCompare(a.started));
  const training = newest.filter((run) => run.state === "training");
  return (training.length ? training : newest).slice(0, SHOWN_FIRST).map((run) => run.name);
}

/** Returns the runs to show, each with a unique label. */
function shownRuns() {
  const runs = listed.filter((run) => chosen.runs?.includes(run.name)).slice(0, SHOWN_MAX);
  const tasks = new Set(runs.map((run) => run.task)).size > 1;
  const label = (run) => `${tasks ? `${run.task} ` : ""}${run.method} seed ${run.seed}`;
  const unique = (run) => runs.filter((other) => label(other) === label(run)).length === 1;
  return runs.map((run) => ({ ...run, label: unique(run) ? label(run) : run.name }));
}

async function look() {
  if (looking) {
    again = true;
    return;
  }
  looking = true;
  clearTimeout(timer);
  try {
    await update();
    get("connection").className = "";
    get("connection").textContent = `as of ${new Date().toLocaleTimeString()}`;
  } catch (error) {
    get("connection").className = "lost";
    get("connection").textContent = error instanceof TypeError || error.name === "TimeoutError"
      ? "no connection: has dmprl dashboard ended? What is shown is what was known last."
      : `${error.message}`;
  }
  looking = false;
  const soon = listed.some((run) => run.state === "training");
  // A hidden page sends no requests.
  if (!document.hidden) timer = setTimeout(look, soon ? LOOK_MS.training : LOOK_MS.still);
  if (again) {
    again = false;
    await look();
  }
}

async function update() {
  const answer = await ask("/api/runs");
  [listed, root, leftOut] = [answer.runs, answer.root, answer.left_out];
  get("root").textContent = root;
  chosen.runs ??= listed.length ? firstChoice() : null;
  drawList();
  const runs = shownRuns();
  const asked = await Promise.allSettled(runs.map((run) => store.update(run)));
  store.keep(runs.map((run) => run.name));
  const labels = JSON.stringify([runs.map((run) => [run.name, run.label]), listed.length > 0]);
  if (labels !== drawn.labels || asked.some((one) => one.value)) {
    drawn.labels = labels;
    drawCurves();
  }
  await configuration.update(runs.filter((run) => !run.fault));
  await showDetails(runs);
  const failed = asked.find((one) => one.status === "rejected");
  if (failed) throw failed.reason;
}

function drawCurves() {
  const runs = shownRuns();
  const { axis, weight, log } = chosen;
  charts.show({ runs, store, styles: styles(runs), axis, weight, log });
  const note = get("nothing");
  note.hidden = runs.some((run) => store.runs.get(run.name)?.files.some((file) => file.next > 0));
  if (!listed.length) note.textContent = "There is no run here yet; one that begins will appear.";
  else if (!runs.length) note.textContent = "No run is chosen.";
  else note.textContent = "Nothing was measured yet: curves begin with the first line of metrics.jsonl.";
}

async function showDetails(runs) {
  const select = get("details-run");
  get("details").hidden = runs.length === 0;
  if (!runs.length) return;
  const run = runs.find((one) => one.name === chosen.details) ?? runs[0];
  const options = runs.map((one) => [one.name, one.label]);
  if (select.dataset.options !== JSON.stringify(options)) {
    select.dataset.options = JSON.stringify(options);
    select.replaceChildren(...options.map(([value, text]) => element("option", { value }, text)));
  }
  select.value = run.name;
  const isRoot = root.endsWith(`/${run.name}`) && listed.length === 1;
  if (!run.fault) await details.update(run, isRoot ? root : `${root}/${run.name}`);
}

function facts(run) {
  if (run.fault) return element("span", { className: "facts fault" }, run.fault);
  const rate = run.success_rate === null ? "" : `, success ${share(run.success_rate)}`;
  const speed = run.state === "training" ? `, ${figure(run.env_steps_per_s)}/s` : "";
  const [done, all] = [run.env_steps, run.steps];
  const progress = done === all ? count(done) : `${count(done)} of ${count(all)}`;
  return element("span", { className: "facts" },
    element("span", { className: "state" }, STATES[run.state]),
    ` · ${run.task} · ${run.method} · seed\u00a0${run.seed}`, element("br"),
    `${progress} steps${speed}, ${duration(run.wall_s)}`, element("br"),
    `return ${figure(run.return_mean)}${rate}`);
}

function drawList() {
  const wanted = get("runs-filter").value.trim().toLowerCase().split(/\s+/);
  const says = (run) => `${run.name} ${run.task} ${run.method} ${run.state}`.toLowerCase();
  const order = { training: 0, stopped: 1, finished: 1 };
  const sorted = [...listed].sort((a, b) => order[a.state] - order[b.state]);
  const found = sorted.filter((run) => wanted.every((word) => says(run).includes(word)));
  const known = styles(shownRuns());
  get("runs-count").textContent = `(${found.length === listed.length ? "" : `${found.length} of `}`
    + `${count(listed.length)}, ${chosen.runs?.length ?? 0} shown)`;
  const full = (chosen.runs?.length ?? 0) >= SHOWN_MAX;
  get("runs-note").textContent = [full ? `At most ${SHOWN_MAX} runs are shown at once.` : "",
    leftOut ? `${count(leftOut)} more runs are below this directory.` : ""].join(" ").trim();
  const list = get("runs");
  const content = JSON.stringify([found, chosen.runs, full, [...known]]);
  if (pressed || content === drawn.list) return;
  drawn.list = content;
  const focused = document.activeElement?.value;
  const inside = list.contains(document.activeElement);
  list.replaceChildren(...found.map((run) => {
    const checked = chosen.runs?.includes(run.name) ?? false;
    const box = element("input", { type: "checkbox", value: run.name, checked,
      disabled: full && !checked });
    const style = known.get(run.name);
    return element("li", { className: run.state }, element("label", {}, box,
      element("span", { className: "name" }, run.name),
      swatch(style?.colour ?? "#0000", style?.dash ?? []), facts(run)));
  }));
  if (inside) list.querySelector(`input[value="${CSS.escape(focused)}"]`)?.focus();
}

function choose(runs) {
  chosen.runs = runs;
  writeAddress();
  look();
}

function listen() {
  get("runs").addEventListener("change", ({ target }) => {
    const others = (chosen.runs ?? []).filter((run) => run !== target.value);
    choose(target.checked ? [...others, target.value] : others);
  });
  get("runs").addEventListener("pointerdown", () => { pressed = true; });
  for (const end of ["pointerup", "pointercancel"]) {
    addEventListener(end, () => setTimeout(() => { pressed = false; }));
  }
  get("runs-filter").addEventListener("input", drawList);
  get("show-training").addEventListener("click", () => choose(listed
    .filter((run) => run.state === "training").slice(0, SHOWN_MAX).map((run) => run.name)));
  get("show-none").addEventListener("click", () => choose([]));
  for (const radio of document.getElementsByName("axis")) {
    radio.checked = radio.value === chosen.axis;
    radio.addEventListener("change", () => set({ axis: radio.value }));
  }
  const [slider, shown] = [get("smoothing"), get("smoothing-shown")];
  const say = () => { shown.value = chosen.weight > 0 ? chosen.weight.toFixed(2) : "off"; };
  slider.value = chosen.weight;
  say();
  slider.addEventListener("input", () => {
    set({ weight: Number(slider.value) });
    say();
  });
  get("log").checked = chosen.log;
  get("log").addEventListener("change", ({ target }) => set({ log: target.checked }));
  get("details-run").addEventListener("change", ({ target }) => {
    chosen.details = target.value;
    writeAddress();
    look();
  });
  get("controls").addEventListener("submit", (event) => event.preventDefault());
  document.addEventListener("visibilitychange", () => {
    if (!document.hidden) look();
  });
}

function set(setting) {
  Object.assign(chosen, setting);
  writeAddress();
  drawCurves();
}

// On a narrow screen the curves come first.
if (matchMedia("(max-width: 52rem)").matches) get("runs-fold").open = false;
listen();
look();
