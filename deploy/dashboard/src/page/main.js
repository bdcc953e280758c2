// The page: selects the runs to show, and refreshes their data.

import { chartKeys, Charts, styles } from "./charts.js";
import { getJson, Store } from "./data.js";
import { Configuration, Details } from "./details.js";
import { count, duration, element, figure, share, swatch } from "./format.js";

/** Interval between two refreshes, while a run is training and otherwise. A refresh costs some
 * hundredths of a second of processor time, which training may need. */
const REFRESH_MS = { training: 4000, idle: 6000 };
/** Maximum number of runs drawn at once: more lines would be indistinguishable. */
const SHOWN_MAX = 12;
/** Maximum number of runs shown initially. */
const SHOWN_INITIALLY = 4;
const STATES = { training: "training", finished: "finished", stopped: "stopped" };

const get = (id) => document.getElementById(id);
const store = new Store(chartKeys());
const charts = new Charts(get("curves"));
const details = new Details();
const configuration = new Configuration();

/** The user's selection. It is kept in the fragment of the URL, so a view can be bookmarked. */
const chosen = readAddress();
let listed = [];
let root = "";
let leftOut = 0;
/** Content currently shown; equal content is not drawn again. */
const drawn = { list: "", labels: "" };
let timer = 0;
let refreshing = false;
let refreshAgain = false;
/** True while a pointer button is pressed. The list is not redrawn then: the click would miss. */
let pressed = false;

function readAddress() {
  const parameters = new URLSearchParams(location.hash.slice(1));
  return {
    runs: parameters.has("run") || parameters.has("none") ? parameters.getAll("run") : null,
    details: parameters.get("details"),
    axis: parameters.get("axis") === "wall_s" ? "wall_s" : "env_steps",
    weight: Math.min(0.95, Math.max(0, Number(parameters.get("smoothing")) || 0)),
    log: parameters.has("log"),
  };
}

function writeAddress() {
  const parameters = new URLSearchParams();
  (chosen.runs ?? []).forEach((run) => parameters.append("run", run));
  if (chosen.runs?.length === 0) parameters.set("none", "");
  if (chosen.details) parameters.set("details", chosen.details);
  if (chosen.axis !== "env_steps") parameters.set("axis", chosen.axis);
  if (chosen.weight > 0) parameters.set("smoothing", chosen.weight);
  if (chosen.log) parameters.set("log", "");
  history.replaceState(null, "", `#${parameters}`);
}

/** Returns the runs shown initially: those in training, else the newest. */
function initialRuns() {
  const newest = [...listed].filter((run) => !run.fault)
    .sort((a, b) => b.started.localeCompare(a.started));
  const training = newest.filter((run) => run.state === "training");
  return (training.length ? training : newest).slice(0, SHOWN_INITIALLY).map((run) => run.name);
}

/** Returns the runs to show, each with a unique label. */
function shownRuns() {
  const runs = listed.filter((run) => chosen.runs?.includes(run.name)).slice(0, SHOWN_MAX);
  const tasks = new Set(runs.map((run) => run.task)).size > 1;
  const label = (run) => `${tasks ? `${run.task} ` : ""}${run.method} seed ${run.seed}`;
  const unique = (run) => runs.filter((other) => label(other) === label(run)).length === 1;
  return runs.map((run) => ({ ...run, label: unique(run) ? label(run) : run.name }));
}

/** Refreshes the page, and schedules the next refresh. */
async function refresh() {
  if (refreshing) {
    refreshAgain = true;
    return;
  }
  refreshing = true;
  clearTimeout(timer);
  try {
    await update();
    get("connection").className = "";
    get("connection").textContent = `as of ${new Date().toLocaleTimeString()}`;
  } catch (error) {
    get("connection").className = "lost";
    get("connection").textContent = error instanceof TypeError || error.name === "TimeoutError"
      ? "no connection to dmprl dashboard; showing the last known state"
      : `${error.message}`;
  }
  refreshing = false;
  const training = listed.some((run) => run.state === "training");
  // A hidden page sends no requests.
  if (!document.hidden) timer = setTimeout(refresh, REFRESH_MS[training ? "training" : "idle"]);
  if (refreshAgain) {
    refreshAgain = false;
    await refresh();
  }
}

async function update() {
  const response = await getJson("/api/runs");
  [listed, root, leftOut] = [response.runs, response.root, response.left_out];
  get("root").textContent = root;
  chosen.runs ??= listed.length ? initialRuns() : null;
  drawList();
  const runs = shownRuns();
  const updates = await Promise.allSettled(runs.map((run) => store.update(run)));
  store.keep(runs.map((run) => run.name));
  const labels = JSON.stringify([runs.map((run) => [run.name, run.label]), listed.length > 0]);
  if (labels !== drawn.labels || updates.some((one) => one.value)) {
    drawn.labels = labels;
    drawCurves();
  }
  await configuration.update(runs.filter((run) => !run.fault));
  await showDetails(runs);
  const failed = updates.find((one) => one.status === "rejected");
  if (failed) throw failed.reason;
}

function drawCurves() {
  const runs = shownRuns();
  const { axis, weight, log } = chosen;
  charts.show({ runs, store, styles: styles(runs), axis, weight, log });
  const note = get("nothing");
  note.hidden = runs.some((run) => store.runs.get(run.name)?.files.some((file) => file.next > 0));
  if (!listed.length) note.textContent = "No runs yet. New runs appear automatically.";
  else if (!runs.length) note.textContent = "No run is selected.";
  else note.textContent = "No data yet. Curves start with the first line of metrics.jsonl.";
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
  const textOf = (run) => `${run.name} ${run.task} ${run.method} ${run.state}`.toLowerCase();
  const order = { training: 0, stopped: 1, finished: 1 };
  const sorted = [...listed].sort((a, b) => order[a.state] - order[b.state]);
  const found = sorted.filter((run) => wanted.every((word) => textOf(run).includes(word)));
  const known = styles(shownRuns());
  get("runs-count").textContent = `(${found.length === listed.length ? "" : `${found.length} of `}`
    + `${count(listed.length)}, ${chosen.runs?.length ?? 0} shown)`;
  const full = (chosen.runs?.length ?? 0) >= SHOWN_MAX;
  get("runs-note").textContent = [full ? `At most ${SHOWN_MAX} runs can be shown at once.` : "",
    leftOut ? `${count(leftOut)} more runs are not listed.` : ""].join(" ").trim();
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

function selectRuns(runs) {
  chosen.runs = runs;
  writeAddress();
  refresh();
}

function listen() {
  get("runs").addEventListener("change", ({ target }) => {
    const others = (chosen.runs ?? []).filter((run) => run !== target.value);
    selectRuns(target.checked ? [...others, target.value] : others);
  });
  get("runs").addEventListener("pointerdown", () => { pressed = true; });
  for (const end of ["pointerup", "pointercancel"]) {
    addEventListener(end, () => setTimeout(() => { pressed = false; }));
  }
  get("runs-filter").addEventListener("input", drawList);
  get("show-training").addEventListener("click", () => selectRuns(listed
    .filter((run) => run.state === "training").slice(0, SHOWN_MAX).map((run) => run.name)));
  get("show-none").addEventListener("click", () => selectRuns([]));
  for (const radio of document.getElementsByName("axis")) {
    radio.checked = radio.value === chosen.axis;
    radio.addEventListener("change", () => set({ axis: radio.value }));
  }
  const [slider, shown] = [get("smoothing"), get("smoothing-shown")];
  const showWeight = () => { shown.value = chosen.weight > 0 ? chosen.weight.toFixed(2) : "off"; };
  slider.value = chosen.weight;
  showWeight();
  slider.addEventListener("input", () => {
    set({ weight: Number(slider.value) });
    showWeight();
  });
  get("log").checked = chosen.log;
  get("log").addEventListener("change", ({ target }) => set({ log: target.checked }));
  get("details-run").addEventListener("change", ({ target }) => {
    chosen.details = target.value;
    writeAddress();
    refresh();
  });
  get("controls").addEventListener("submit", (event) => event.preventDefault());
  document.addEventListener("visibilitychange", () => {
    if (!document.hidden) refresh();
  });
}

function set(setting) {
  Object.assign(chosen, setting);
  writeAddress();
  drawCurves();
}

// On a narrow screen the list is folded, so that the curves come first.
if (matchMedia("(max-width: 52rem)").matches) get("runs-fold").open = false;
listen();
refresh();
