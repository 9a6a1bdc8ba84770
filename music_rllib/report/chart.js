// A subplot: a metric of several conditions on one task, as an SVG whose values can be read.
// A curve: {label, color, dashes, x, mean, lower, upper, runs, seeds}; null stands for NaN.
"use strict";

const MOST_BANDS = 8, LETTER = 6.9, SAME = 0.008, DASH = 7;

function element(name, attributes, parent, text) {
  const isSvg = ["svg", "g", "path", "line", "rect", "text", "clipPath", "circle"].includes(name);
  const made = isSvg ? document.createElementNS("http://www.w3.org/2000/svg", name)
    : document.createElement(name);
  for (const [key, value] of Object.entries(attributes ?? {})) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
}

function shown(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size >= 100) return Math.round(value).toLocaleString("en");
  return size && size < 0.01 ? value.toPrecision(2) : value.toFixed(2);
}

/** Round numbers from `low` to `high`, about `count` of them. */
function ticksOf(low, high, count) {
  const raw = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(raw));
  const round = [1, 2, 2.5, 5, 10].find((one) => one * power >= raw * 0.999), step = round * power;
  const ticks = [];
  for (let at = Math.ceil(low / step - 1e-9); at * step <= high + step * 1e-9; at++) ticks.push(at * step);
  const decimals = Math.max(0, -Math.floor(Math.log10(step * 1.0001)) + (round === 2.5 ? 1 : 0));
  const text = (value) => {
    for (const [unit, sign] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]]) {
      const digits = decimals + Math.log10(unit);
      if (Math.abs(value) >= unit) return `${+(value / unit).toFixed(Math.min(digits, 8))}${sign}`;
    }
    return value.toFixed(Math.min(decimals, 8));
  };
  return ticks.map((value) => [value, text(Math.abs(value) < step * 1e-6 ? 0 : value)]);
}

/** Linear between the points of a curve; null outside its range. */
function valueAt(x, xs, ys) {
  let right = xs.findIndex((one) => one >= x);
  if (right < 0 || (right === 0 && xs[0] > x)) return null;
  if (xs[right] === x) return ys[right];
  const [a, b] = [ys[right - 1], ys[right]];
  if (a === null || b === null) return null;
  return a + (b - a) * (x - xs[right - 1]) / (xs[right] - xs[right - 1]);
}

/** For each point of each curve, the number of earlier curves that run through it. */
function ranksOf(curves, height) {
  return curves.map((curve, number) => curve.x.map((x, point) => {
    if (curve.mean[point] === null) return 0;
    return curves.slice(0, number).filter((other) => {
      const value = valueAt(x, other.x, other.mean);
      return value !== null && Math.abs(value - curve.mean[point]) <= SAME * height;
    }).length;
  }));
}

/** An SVG path through points, with a gap where a value is missing. */
function lineThrough(points) {
  let path = "", pen = "M";
  for (const point of points) {
    if (point === null) { pen = "M"; continue; }
    path += `${pen}${point[0].toFixed(1)} ${point[1].toFixed(1)}`;
    pen = "L";
  }
  return path;
}

function limitsOf(curves, metric) {
  if (metric.limits) return metric.limits;
  // The lines set the limits: a band of two seeds may be many times as wide.
  const lines = (curve) => [curve.mean, ...(curves.length <= MOST_BANDS ? curve.seeds : [])];
  const all = curves.flatMap(lines).flat().filter((v) => v !== null);
  let low = all.length ? all.reduce((a, b) => Math.min(a, b)) : 0;
  let high = all.length ? all.reduce((a, b) => Math.max(a, b)) : 1;
  if (low === high) [low, high] = [low - 0.5, high + 0.5];
  return [low - 0.04 * (high - low), high + 0.04 * (high - low)];
}

let subplots = 0;

/** Draws the subplot into `box` and replaces its content; metric: {title, axis, limits, target}. */
function drawSubplot(box, { title, curves, metric, xLabel }) {
  const width = Math.max(260, box.clientWidth || 400);
  const height = Math.round(Math.min(420, Math.max(210, width * 0.62)));
  const [low, high] = limitsOf(curves, metric);
  const yTicks = ticksOf(low, high, 5);
  const margin = {
    left: 26 + LETTER * Math.max(...yTicks.map(([, text]) => text.length)),
    right: 14, top: 10, bottom: 40,
  };
  const last = Math.max(...curves.map((curve) => curve.x.at(-1) ?? 0)) || 1;
  const plotWidth = width - margin.left - margin.right, plotHeight = height - margin.top - margin.bottom;
  const px = (x) => margin.left + x / last * plotWidth;
  const py = (y) => margin.top + (high - y) / (high - low) * plotHeight;
  const svg = element("svg", {
    viewBox: `0 0 ${width} ${height}`, role: "img", tabindex: 0, class: "chart",
    "aria-label": `${metric.title}${title ? ", " + title : ""}. Left and right arrow keys read values.`,
  });
  const clip = `clip-${++subplots}`;
  element("rect", { x: margin.left, y: margin.top - 2, width: plotWidth + 2, height: plotHeight + 4 },
    element("clipPath", { id: clip }, svg));
  for (const [value, text] of yTicks) {
    element("line", { x1: margin.left, x2: width - margin.right, y1: py(value), y2: py(value), class: "grid" }, svg);
    element("text", { x: margin.left - 5, y: py(value) + 4, "text-anchor": "end" }, svg, text);
  }
  for (const [value, text] of curves.length ? ticksOf(0, last, Math.min(6, plotWidth / 55)) : []) {
    element("line", { x1: px(value), x2: px(value), y1: margin.top, y2: margin.top + plotHeight, class: "grid" }, svg);
    const anchor = px(value) > width - 20 ? "end" : "middle";
    element("text", { x: px(value), y: height - margin.bottom + 15, "text-anchor": anchor }, svg, text);
  }
  element("text", { x: margin.left + plotWidth / 2, y: height - 6, "text-anchor": "middle" }, svg, xLabel);
  element("text", {
    transform: `translate(11 ${margin.top + plotHeight / 2}) rotate(-90)`, "text-anchor": "middle",
  }, svg, metric.axis);
  const inside = element("g", { "clip-path": `url(#${clip})` }, svg);
  if (metric.target) {
    element("line", { x1: margin.left, x2: width, y1: py(metric.target), y2: py(metric.target), class: "target" }, inside);
  }
  drawCurves(inside, curves, px, py, high - low);
  element("path", {
    d: `M${margin.left} ${margin.top}V${margin.top + plotHeight}H${width - margin.right}`, class: "axis",
  }, svg);
  box.replaceChildren(...(title ? [element("p", { class: "title" }, null, title)] : []), svg);
  readable(box, svg, { curves, px, last, margin, plotHeight, xLabel });
}

function drawCurves(parent, curves, px, py, height) {
  const at = (curve, values) => values.map((v, i) => (v === null ? null : [px(curve.x[i]), py(v)]));
  // Bands of more lines would hide each other; the intervals are shown beside the pointer.
  for (const curve of curves.length <= MOST_BANDS ? curves : []) {
    const there = curve.x.map((_, i) => curve.lower[i] !== null && curve.upper[i] !== null);
    if (there.filter(Boolean).length > 1) {
      const keep = (values) => at(curve, values).filter((_, i) => there[i]);
      element("path", {
        d: `${lineThrough([...keep(curve.upper), ...keep(curve.lower).reverse()])}Z`, fill: curve.color, opacity: 0.15,
      }, parent);
    }
    for (const seed of curve.seeds) {
      element("path", { d: lineThrough(at(curve, seed)), stroke: curve.color, class: "seed" }, parent);
    }
  }
  const ranks = ranksOf(curves, height);
  curves.forEach((curve, number) => {
    const most = Math.max(...curve.runs), points = at(curve, curve.mean);
    // If curves coincide, the later ones are dashed, so that the earlier ones are visible in the gaps.
    const key = (i) => `${Math.min(ranks[number][i], ranks[number][i + 1])} ${curve.runs[i + 1] < most ? 1 : 0}`;
    for (let begin = 0; begin < points.length - 1;) {
      let end = begin + 1;
      while (end < points.length - 1 && key(end) === key(begin)) end++;
      const [rank, thin] = key(begin).split(" ").map(Number);
      const dash = rank ? `${DASH} ${DASH * rank}` : curve.dashes;
      element("path", {
        d: lineThrough(points.slice(begin, end + 1)), stroke: curve.color, class: "curve",
        "stroke-width": thin ? 1 : 2.2, ...(dash ? { "stroke-dasharray": dash } : {}),
      }, parent);
      begin = end;
    }
    if (points.length === 1 && points[0]) {
      element("circle", { cx: points[0][0], cy: points[0][1], r: 3, fill: curve.color }, parent);
    }
  });
}

/** Shows the values at the pointer, or at the position that arrow keys select. */
function readable(box, svg, { curves, px, last, margin, plotHeight, xLabel }) {
  const grid = [...new Set(curves.flatMap((curve) => curve.x))].sort((a, b) => a - b);
  const guide = element("line", { class: "guide", y1: margin.top, y2: margin.top + plotHeight, visibility: "hidden" }, svg);
  const tip = element("div", { class: "tip", hidden: "" }, box);
  const note = element("span", { class: "unseen", "aria-live": "polite" }, box);
  let place = grid.length - 1;
  const show = (aloud) => {
    const x = grid[place];
    const lines = curves.map((curve) => {
      const value = valueAt(x, curve.x, curve.mean);
      const [lower, upper] = [valueAt(x, curve.x, curve.lower), valueAt(x, curve.x, curve.upper)];
      const runs = curve.runs[curve.x.findIndex((one) => one >= x)];
      const ends = lower === null || upper === null ? "" : ` (${shown(lower)} to ${shown(upper)})`;
      return { curve, value, text: `${curve.label}: ${shown(value)}${ends}, ${runs} run${runs === 1 ? "" : "s"}` };
    }).filter((line) => line.value !== null).sort((a, b) => b.value - a.value);
    guide.setAttribute("visibility", "visible");
    guide.setAttribute("x1", px(x));
    guide.setAttribute("x2", px(x));
    tip.replaceChildren(element("strong", {}, null, `${shown(x)} ${xLabel.replace(/ \((.*)\)/, ", $1")}`));
    for (const line of lines.slice(0, 12)) {
      const row = element("div", {}, tip);
      element("span", { class: "dot" }, row).style.background = line.curve.color;
      row.append(line.text);
    }
    if (lines.length > 12) element("div", {}, tip, `and ${lines.length - 12} more`);
    tip.hidden = false;
    const scale = svg.clientWidth / svg.viewBox.baseVal.width, left = px(x) * scale;
    const right = left > box.clientWidth / 2;
    tip.style.left = right ? "auto" : `${left + 10}px`;
    tip.style.right = right ? `${box.clientWidth - left + 10}px` : "auto";
    if (aloud) note.textContent = tip.innerText;
  };
  const hide = () => { tip.hidden = true; guide.setAttribute("visibility", "hidden"); };
  svg.addEventListener("pointermove", (event) => {
    if (!grid.length) return;
    const frame = svg.getBoundingClientRect();
    const wide = svg.viewBox.baseVal.width / frame.width;
    const x = ((event.clientX - frame.left) * wide - margin.left) / (px(last) - margin.left) * last;
    place = grid.reduce((best, one, i) => (Math.abs(one - x) < Math.abs(grid[best] - x) ? i : best), 0);
    show(false);
  });
  svg.addEventListener("pointerleave", hide);
  svg.addEventListener("blur", hide);
  svg.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === "Escape") hide();
    if (!way || !grid.length) return;
    event.preventDefault();
    place = Math.min(grid.length - 1, Math.max(0, place + way));
    show(true);
  });
}
