// The running sweep: its progress every two seconds, and new pages.
"use strict";

const asked = (path) => fetch(path, { cache: "no-store" });
const PARTS = ["facts", "notes", "answer", "curves", "details", "contents", "groups", "searches", "origin"];
let version = document.body.dataset.version;

function time(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const [hours, minutes] = [Math.floor(seconds / 3600), Math.floor(seconds / 60) % 60];
  return hours ? `${hours} h ${minutes} min` : minutes ? `${minutes} min` : `${Math.round(seconds)} s`;
}

/** Replaces the parts of the page that have changed. */
async function renew() {
  const page = new DOMParser().parseFromString(await (await asked("/")).text(), "text/html");
  data = JSON.parse(page.getElementById("data").textContent);
  for (const id of PARTS) {
    const [before, now] = [document.getElementById(id), page.getElementById(id)];
    if (!before || !now || before.source === now.innerHTML) continue;
    const open = [...before.querySelectorAll("details")].map((one) => one.open);
    before.source = now.innerHTML;
    before.style.minHeight = `${before.offsetHeight}px`;
    const charts = new Map([...before.querySelectorAll("figure")].map((one) => [one.id, one.querySelector(".live")]));
    before.replaceChildren(...now.childNodes);
    // The old charts stay until the new ones are drawn.
    for (const figure of before.querySelectorAll("figure")) {
      const chart = charts.get(figure.id);
      if (chart) figure.querySelector(".live")?.replaceWith(chart);
    }
    [...before.querySelectorAll("details")].forEach((one, i) => { one.open = open[i] ?? one.open; });
    requestAnimationFrame(() => { before.style.minHeight = ""; });
  }
  refresh();
}

function bar(parent, label, done, whole, text) {
  const row = element("div", { class: "row" }, parent);
  element("span", {}, row, label);
  const meter = element("progress", { max: Math.max(1, whole), "aria-label": label }, row);
  meter.value = done;
  element("span", { class: "soft" }, row, text);
}

function showState(state) {
  const parent = document.getElementById("live");
  if (!parent.children.length) for (const tag of ["p", "p", "div"]) element(tag, {}, parent);
  const [above, hint, below] = parent.children;
  const head = document.createDocumentFragment(), box = document.createDocumentFragment();
  element("strong", {}, head, `The sweep is ${state.state}. `);
  if (state.done !== undefined) {
    const speed = state.speed ? `, ${shown(state.speed)} environment steps per second` : "";
    const most = state.at_most ? "at most " : "";
    const left = state.seconds_left ? `, ${most}${time(state.seconds_left)} more` : "";
    head.append(`${state.done.toLocaleString("en")} environment steps done, ${most}${state.left.toLocaleString("en")} left${speed}${left}. `);
  }
  if (state.error) head.append(state.error);
  above.replaceChildren(head);
  const use = state.command ? `${state.state === "running" ? "To stop it: " : "To resume it: "}${state.command}` : "";
  if (hint.textContent !== use) {  // the reader may have selected it
    hint.replaceChildren(use.slice(0, use.indexOf(": ") + 2));
    if (use) element("code", {}, hint, state.command);
  }
  const bars = element("div", { class: "bars" }, box);
  for (const stage of state.stages ?? []) {
    const { finished: own = 0, reused = 0, ...others } = stage.runs;  // a reused run is a finished one
    const finished = own + reused, counts = Object.entries(others);
    const all = counts.reduce((sum, [, n]) => sum + n, finished);
    const texts = [`${finished} of ${all} finished${reused ? ` (${reused} reused)` : ""}`, ...counts.map(([name, n]) => `${n} ${name}`)];
    bar(bars, stage.name, finished + (stage.runs.failed ?? 0) + (stage.runs.pruned ?? 0), all, texts.join(", "));
  }
  for (const run of state.running ?? []) {
    const steps = `${run.env_steps.toLocaleString("en")} of ${run.budget.toLocaleString("en")}`;
    bar(bars, run.run, run.env_steps, run.budget, `${steps}, ${run.metric} ${shown(run.value)}`);
  }
  for (const failure of state.failures ?? []) {
    const line = element("p", { class: "note" }, box);
    element("strong", {}, line, `${failure.run} failed: `);
    line.append(failure.cause);
  }
  below.replaceChildren(box);
}

async function look() {
  let state;
  try {
    state = await (await asked("/state")).json();
  } catch {
    showState({ state: "unknown: the page's server has ended" });
    return;
  }
  showState(state);
  if (state.version && state.version !== version) await renew();
  version = state.version ?? version;
}

document.title = `live: ${document.title}`;
look();
setInterval(look, 2000);
