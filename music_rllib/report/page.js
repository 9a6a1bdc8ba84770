// The reader's controls: conditions, tasks, metric, x axis and smoothing of curves; sorting of tables.
"use strict";

const X_AXES = {
  steps: "environment steps",
  updates: "gradient updates",
  seconds: "training time",
  epochs: "epochs of 80,000 steps",
};
const choice = { stageName: null, stage: 0, metric: "", x: "steps", smooth: 1, conditions: new Set(), subplots: new Set() };
let data = JSON.parse(document.getElementById("data").textContent);

/** Means over the `width` nearest points; missing values stay missing. */
function smoothed(values, width) {
  if (width <= 1) return values;
  const half = (width - 1) / 2;
  return values.map((value, i) => {
    if (value === null) return null;
    const near = values.slice(Math.max(0, i - half), i + half + 1).filter((v) => v !== null);
    return near.reduce((a, b) => a + b, 0) / near.length;
  });
}

function timeUnit(curves) {
  const last = Math.max(0, ...curves.map((curve) => curve.seconds?.at(-1) ?? 0));
  return last >= 7200 ? [3600, "h"] : last >= 120 ? [60, "min"] : [1, "s"];
}

/** The selected curves of one subplot, with the selected x axis and smoothing. */
function chosen(stage, metric, subplot) {
  const found = (data.curves[stage]?.[metric] ?? []).filter((curve) => curve.subplot === subplot);
  const kept = found.filter((curve) => !choice.conditions.has(data.stages[stage].conditions[curve.condition].key));
  const [unit, word] = timeUnit(kept);
  const xOf = {
    steps: (curve) => curve.steps,
    updates: (curve) => curve.updates,
    seconds: (curve) => curve.seconds?.map((one) => (one === null ? null : one / unit)),
    epochs: (curve) => curve.steps.map((one) => one / data.epoch),
  }[choice.x];
  const curves = kept.filter((curve) => xOf(curve)).map((curve) => {
    const x = xOf(curve), there = x.map((one) => one !== null);
    const keep = (values) => smoothed(values, choice.smooth).filter((_, i) => there[i]);
    return {
      ...data.stages[stage].conditions[curve.condition],
      x: x.filter((one) => one !== null),
      runs: curve.runs.filter((_, i) => there[i]),
      mean: keep(curve.mean), lower: keep(curve.lower), upper: keep(curve.upper),
      seeds: curve.seeds.map(keep),
    };
  }).filter((curve) => curve.x.length);
  return { curves, xLabel: choice.x === "seconds" ? `training time (${word})` : X_AXES[choice.x] };
}

const metricOf = (name) => data.metrics.find((metric) => metric.name === name);
const pending = new Map();
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) drawNow(entry.target);
}, { rootMargin: "600px" });

function drawNow(box) {
  const subplot = pending.get(box);
  pending.delete(box);
  if (subplot) drawSubplot(box, { ...subplot, ...chosen(subplot.stage, subplot.metric.name, subplot.subplot) });
}

/** Makes a box for each subplot of each stage, which is drawn when it comes near the window. */
function fill(parent, wanted) {
  // The only subplot of a stage has no checkbox.
  const isShown = (names, subplot) => names.length < 2 || !choice.subplots.has(names[subplot]);
  const boxes = wanted.filter(({ stage, subplot }) => isShown(data.stages[stage].subplots, subplot));
  while (parent.children.length > boxes.length) parent.lastChild.remove();
  boxes.forEach((subplot, i) => {
    const box = parent.children[i] ?? element("div", { class: "subplot" }, parent);
    pending.set(box, subplot);
    watcher.unobserve(box);
    watcher.observe(box);
  });
}

function subplotsOf(metric, stages) {
  return stages.flatMap((stage) => data.stages[stage].subplots.map((name, subplot) => ({ stage, subplot, name })))
    .map((one) => ({ ...one, metric: metricOf(metric || data.stages[one.stage].primary[one.subplot]) }))
    .filter((one) => (data.curves[one.stage]?.[one.metric.name] ?? []).some((curve) => curve.subplot === one.subplot));
}

function drawAll() {
  const own = data.stages.map((_, i) => i).filter((i) => !data.stages[i].together);
  const several = own.length > 1;
  for (const figure of document.querySelectorAll("figure[data-metric]")) {
    const large = figure.dataset.metric === "";
    const wanted = subplotsOf(large ? choice.metric : figure.dataset.metric, large ? [choice.stage] : own);
    const parent = figure.querySelector(".live");
    fill(parent, wanted.map((one) => ({
      ...one,
      title: [!large && several ? data.stages[one.stage].name : "", one.name].filter(Boolean).join(" · "),
    })));
    figure.classList.add("drawn");
  }
  for (const part of document.querySelectorAll(".static [data-subplot]")) {
    part.hidden = choice.subplots.has(part.dataset.subplot);
  }
}

// Controls ---------------------------------------------------------------------------------------

function select(parent, label, options, value, change) {
  const box = element("label", {}, parent, `${label} `);
  const list = element("select", {}, box);
  for (const [key, text] of options) {
    const option = element("option", { value: key }, list, text);
    option.selected = String(key) === String(value);
  }
  list.addEventListener("change", () => { change(list.value); drawAll(); });
}

function chips(parent, title, all, off) {
  const entries = [...new Map(all.map((one) => [one.key, one])).values()];
  if (entries.length < 2) return;
  const group = element("fieldset", { class: "chips" }, parent);
  element("legend", {}, group, title);
  for (const { key, label, color, dashes } of entries) {
    const chip = element("label", { class: "chip" }, group);
    const tick = element("input", { type: "checkbox" }, chip);
    tick.checked = !off.has(key);
    tick.addEventListener("change", () => { off[tick.checked ? "delete" : "add"](key); drawAll(); });
    if (color) {
      const line = element("svg", { width: 24, height: 8, "aria-hidden": "true" }, chip);
      element("line", { x1: 0, x2: 24, y1: 4, y2: 4, stroke: color, "stroke-width": 3, "stroke-dasharray": dashes || "none" }, line);
    }
    chip.append(label);
  }
  if (entries.length < 4) return;
  for (const [text, keys] of [["all", []], ["none", entries.map((one) => one.key)]]) {
    element("button", { type: "button" }, group, text).addEventListener("click", () => {
      for (const { key } of entries) off.delete(key);
      for (const key of keys) off.add(key);
      controls();
      drawAll();
    });
  }
}

function controls() {
  const parent = document.getElementById("controls");
  if (!parent || !data.stages.length) return;
  const stage = data.stages[choice.stage];
  const available = data.metrics.filter((metric) => data.curves[choice.stage]?.[metric.name]);
  if (choice.metric && !available.some((metric) => metric.name === choice.metric)) choice.metric = "";
  const focusable = () => [...parent.querySelectorAll("select, input, button")];
  const focused = focusable().indexOf(document.activeElement);
  parent.replaceChildren();
  const row = element("div", { class: "choices" }, parent);
  if (data.stages.length > 1) {
    select(row, "stage", data.stages.map((one, i) => [i, one.name]), choice.stage, (value) => {
      choice.stage = +value;
      choice.stageName = data.stages[choice.stage].name;
      controls();
    });
  }
  select(row, "metric", [["", "primary metric of the task"], ...available.map((one) => [one.name, one.title])],
    choice.metric, (value) => { choice.metric = value; });
  select(row, "against", Object.entries(X_AXES), choice.x, (value) => { choice.x = value; });
  select(row, "smooth", [1, 3, 5, 9, 15].map((n) => [n, n === 1 ? "no" : `mean of ${n} points`]), choice.smooth,
    (value) => { choice.smooth = +value; });
  chips(parent, stage.faceted ? "subplots" : "tasks", stage.subplots.map((name) => ({ key: name, label: name })), choice.subplots);
  chips(parent, "conditions", stage.conditions, choice.conditions);
  parent.classList.toggle("tall", parent.offsetHeight > innerHeight / 5);
  focusable()[focused]?.focus();
}

// Tables -----------------------------------------------------------------------------------------

const orders = new Map();

function sortKey(cell) {
  const text = cell.textContent.trim().replace(/^\d+% CI |^TOST |^unadjusted /, "");
  if (/^\d+(:\d\d)+$/.test(text)) return text.split(":").reduce((sum, part) => 60 * sum + +part, 0);
  const number = parseFloat(text.replaceAll(",", "").replace(/^[^\d.-]+/, ""));
  if (text === "–" || /^(not|no) /.test(text)) return Infinity;
  return /^[\s>p=<+-]*[\d.,]+/.test(text) && !Number.isNaN(number) ? number : text.toLowerCase();
}

function sortBy(table, column, down) {
  const rows = [...table.tBodies[0].rows].map((row) => [sortKey(row.cells[column]), row]);
  const compare = (a, b) => (typeof a === typeof b ? (a < b ? -1 : +(a > b)) : typeof a === "number" ? -1 : 1);
  rows.sort(([a], [b]) => (down ? compare(b, a) : compare(a, b)));
  table.tBodies[0].append(...rows.map(([, row]) => row));
  [...table.tHead.rows[0].cells].forEach((cell, i) => {
    if (i === column) cell.setAttribute("aria-sort", down ? "descending" : "ascending");
    else cell.removeAttribute("aria-sort");
  });
}

function sortable() {
  for (const table of document.querySelectorAll("table")) {
    if (table.tBodies[0].rows.length < 2 || table.querySelector("th button")) continue;
    const name = table.closest("[aria-label]")?.getAttribute("aria-label");
    [...table.tHead.rows[0].cells].forEach((cell, column) => {
      const button = element("button", { type: "button", class: "sort" }, null, cell.textContent);
      cell.replaceChildren(button);
      button.addEventListener("click", () => {
        const down = cell.getAttribute("aria-sort") === "ascending";
        orders.set(name, [column, down]);
        sortBy(table, column, down);
      });
    });
    // Another table with this name may have fewer columns.
    const [column, down] = orders.get(name) ?? [Infinity];
    if (column < table.tHead.rows[0].cells.length) sortBy(table, column, down);
  }
}

// ------------------------------------------------------------------------------------------------

function refresh() {
  // By its name: stages that begin later may have smaller numbers.
  const found = data.stages.findIndex((one) => one.name === choice.stageName);
  choice.stage = found < 0 ? data.main : found;
  controls();
  drawAll();
  sortable();
}

refresh();
let width = innerWidth, timer = 0;
addEventListener("resize", () => {
  clearTimeout(timer);
  if (innerWidth !== width) timer = setTimeout(() => { width = innerWidth; drawAll(); }, 150);
});
addEventListener("beforeprint", () => [...pending.keys()].forEach(drawNow));
