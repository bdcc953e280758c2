// Draws the charts of the page.

import { compact, duration, element, figure, swatch } from "./format.js";

const HEIGHT = 220;
const DASHES = [[], [9, 4], [2, 3], [9, 3, 2, 3], [16, 4], [5, 2]];
const SECONDS = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 21600,
  43200, 86400, 172800, 432000, 864000];

/** All charts by group: title, unit, file of the run, key, and whether a log scale is possible. */
const GROUPS = [
  ["Evaluation, without exploration", [
    ["Return", "mean over episodes", "evaluations", "return_mean"],
    ["Success rate", "fraction of episodes", "evaluations", "success_rate"],
    ["Smoothness", "mean change of actions; lower is smoother", "evaluations", "smoothness"],
  ]],
  ["Training, with exploration", [
    ["Training return", "mean over episodes", "metrics", "training_return_mean"],
    ["Training success rate", "fraction of episodes", "metrics", "training_success_rate"],
  ]],
  ["Throughput and queues", [
    ["Environment steps", "1/s", "metrics", "env_steps_per_s", true],
    ["Updates", "1/s", "metrics", "updates_per_s", true],
    ["Queued segments", "waiting for the learner", "metrics", "queued_segments"],
    ["Policy lag", "versions, maximum", "metrics", "policy_lag_max"],
    ["Updates owed", "due according to the pacing", "metrics", "updates_owed"],
    ["Workers", "attached", "metrics", "workers"],
  ]],
  ["Learning", [
    ["Critic loss", "mean squared error", "metrics", "critic_loss", true],
    ["Actor loss", "−mean Q plus regularization", "metrics", "actor_loss"],
    ["Mean Q", "over the samples", "metrics", "q_mean"],
    ["Temperature", "weight of the entropy", "metrics", "temperature"],
    ["Entropy", "nat", "metrics", "entropy"],
    ["Policy loss", "negative clipped objective", "metrics", "policy_loss"],
    ["Value loss", "mean squared error", "metrics", "value_loss", true],
    ["Divergence from the acting policy", "approximate KL [nat]", "metrics", "approx_kl"],
    ["Clipped steps", "fraction", "metrics", "clip_fraction"],
  ]],
];

/** Returns the keys that the charts need, by file. */
export function chartKeys() {
  const found = { metrics: [], evaluations: [] };
  for (const [, charts] of GROUPS) for (const [, , file, key] of charts) found[file].push(key);
  return found;
}

/** Assigns a line style to each run: the method's colour, and dashes if several runs share it. */
export function styles(runs) {
  const seen = new Map();
  return new Map(runs.map((run) => {
    const number = seen.get(run.colour) ?? 0;
    seen.set(run.colour, number + 1);
    return [run.name, { colour: run.colour, dash: DASHES[number % DASHES.length] }];
  }));
}

/** Returns the exponential moving average, with bias correction: it starts at the first value. */
function smoothed(values, weight) {
  let [mean, mass] = [0, 0];
  return values.map((value) => {
    if (value === null) return null;
    mean = weight * mean + (1 - weight) * value;
    mass = weight * mass + (1 - weight);
    return mean / mass;
  });
}

/** Returns the axes of a plot. */
function axes(axis) {
  const line = { stroke: "#595959", font: "12px system-ui", grid: { stroke: "#e8e8e8", width: 1 },
    ticks: { stroke: "#d4d4d4", width: 1, size: 4 } };
  const steps = { ...line, label: "environment steps", values: (_, ticks) => ticks.map(compact) };
  const time = { ...line, label: "training time", incrs: SECONDS,
    values: (_, ticks) => ticks.map(duration) };
  const own = { ...line, label: axis, values: (_, ticks) => ticks.map(figure) };
  const x = { env_steps: steps, wall_s: time }[axis] ?? own;
  x.labelSize = 22;
  x.labelFont = "12px system-ui";
  x.size = 28;
  x.space = 64;
  const y = { ...line, size: 62, values: (_, ticks) => ticks.map((tick) =>
    (tick === null ? "" : figure(tick))) };
  return [x, y];
}

/** Returns the number of points of all lines, and the largest x. */
function extent(lines) {
  const ends = lines.map(({ x }) => x[x.length - 1]);
  return { points: lines.reduce((sum, { x }) => sum + x.length, 0), end: Math.max(...ends) };
}

/** A plot with a legend that shows the values at the pointer, or else the last values. */
export class Plot {
  constructor(title, unit) {
    this.plot = element("div", { className: "plot" });
    this.readout = element("ul", { className: "readout" });
    this.figure = element("figure", {},
      element("figcaption", {}, title, " ", element("span", {}, unit)), this.plot, this.readout);
    this.title = title;
    this.shape = "";
    new ResizeObserver(() => this.fit()).observe(this.plot);
  }

  fit() {
    const width = this.plot.clientWidth;
    if (this.uplot && width && width !== this.uplot.width) this.uplot.setSize({ width, height: HEIGHT });
  }

  /** Draws lines {label, style, x, y}; `axis` names the horizontal axis. */
  draw(lines, { axis, weight = 0, log = false }) {
    this.lines = lines;
    const pairs = [];
    const series = [{}];
    for (const { style, x, y } of lines) {
      const line = { stroke: style.colour, dash: style.dash, width: 2, spanGaps: true,
        points: { show: x.length < 2 } };
      if (weight > 0) {
        series.push({ ...line, width: 1, alpha: 0.3, points: { show: false } });
        pairs.push([x, y]);
      }
      series.push(line);
      pairs.push([x, weight > 0 ? smoothed(y, weight) : y]);
    }
    const data = uPlot.join(pairs);
    const shape = JSON.stringify([series, axis, log]);
    if (this.uplot && shape === this.shape) {
      this.uplot.setData(data, !this.zoomed);
      if (this.zoomed) this.uplot.redraw();
    } else {
      this.create(series, data, axis, log);
      this.shape = shape;
    }
    this.seriesPerLine = weight > 0 ? 2 : 1;
    const { points, end } = extent(lines);
    // For tests.
    Object.assign(this.figure.dataset, { points, end });
    const { left, idx } = this.uplot.cursor;
    this.writeLegend(left >= 0 ? idx : null);
  }

  create(series, data, axis, log) {
    this.uplot?.destroy();
    this.zoomed = false;
    const options = {
      width: this.plot.clientWidth || 400, height: HEIGHT, series, axes: axes(axis),
      legend: { show: false }, scales: { x: { time: false }, y: { distr: log ? 3 : 1 } },
      cursor: { sync: { key: axis }, points: { size: 6 } },
      hooks: {
        setCursor: [(plot) => this.writeLegend(plot.cursor.left >= 0 ? plot.cursor.idx : null)],
        setSelect: [() => { this.zoomed = true; }],
      },
    };
    this.uplot = new uPlot(options, data, this.plot);
    this.uplot.over.addEventListener("dblclick", () => { this.zoomed = false; });
    this.plot.firstElementChild.setAttribute("aria-hidden", "true");
  }

  /** Shows the values at an index, or the last values if it is null. */
  writeLegend(index) {
    const data = this.uplot?.data;
    if (!data) return;
    const at = (column) => {
      let row = index ?? column.length - 1;
      while (row > 0 && (column[row] === null || column[row] === undefined)) row -= 1;
      return column[row];
    };
    this.readout.replaceChildren(...this.lines.map(({ label, style }, number) =>
      element("li", {}, swatch(style.colour, style.dash),
        `${label}: ${figure(at(data[number * this.seriesPerLine + 1]) ?? null)}`)));
  }

  destroy() {
    this.uplot?.destroy();
    [this.uplot, this.shape] = [null, ""];
  }
}

/** All charts. Each is drawn when it becomes visible. */
export class Charts {
  constructor(parent) {
    this.charts = [];
    const observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const chart = this.charts.find((one) => one.plot.figure === entry.target);
        chart.visible = entry.isIntersecting;
        if (chart.visible) this.drawOne(chart);
      }
    }, { rootMargin: "300px" });
    for (const [title, charts] of GROUPS) {
      const group = element("div", { className: "charts" });
      const section = element("section", {}, element("h2", {}, title), group);
      for (const [name, unit, file, key, allowsLog] of charts) {
        const plot = new Plot(name, unit);
        plot.figure.dataset.key = key;
        group.append(plot.figure);
        this.charts.push({ plot, file, key, allowsLog, section, visible: false, stale: true });
        observer.observe(plot.figure);
      }
      parent.append(section);
    }
  }

  /** Shows a view: runs with labels and styles, the store with their curves, and settings. */
  show(view) {
    this.view = view;
    for (const chart of this.charts) {
      const hasData = view.runs.some((run) => view.store.curve(run.name, chart.file, chart.key));
      chart.plot.figure.hidden = !hasData;
      chart.stale = true;
    }
    for (const { section } of this.charts) {
      section.hidden = [...section.querySelectorAll("figure")].every((one) => one.hidden);
    }
    for (const chart of this.charts) if (chart.visible) this.drawOne(chart);
  }

  drawOne(chart) {
    if (!this.view || !chart.stale || chart.plot.figure.hidden) return;
    chart.stale = false;
    const { runs, store, styles: known, axis, weight } = this.view;
    const log = this.view.log && Boolean(chart.allowsLog);
    const lines = runs.flatMap((run) => {
      const curve = store.curve(run.name, chart.file, chart.key);
      if (!curve) return [];
      // A log scale cannot show 0.
      const y = log ? curve.values.map((value) => (value > 0 ? value : null)) : curve.values;
      return [{ label: run.label, style: known.get(run.name), x: curve[axis], y }];
    });
    const positive = lines.some(({ y }) => y.some((value) => value !== null));
    chart.plot.draw(lines, { axis, weight, log: log && positive });
  }
}
