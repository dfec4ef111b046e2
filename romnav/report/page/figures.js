"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const DASHES = ["", "6 3", "2 3", "8 3 2 3", "1 4", "10 4", "4 2", "3 6"];
const colour = (k) => `var(--c${k % 8})`;
const percent = (x) => `${Math.round(x)} %`;

/** Element with attributes, listeners (functions) and children; SVG where its name is SVG's. */
function make(name, attributes = {}, ...children) {
  const drawn = ["svg", "g", "line", "path", "circle", "text", "rect"].includes(name);
  const element = drawn ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key, value);
    else if (value !== null && value !== undefined) element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

function figure(title, description, drawing, key = null) {
  drawing.setAttribute("role", "img");
  drawing.setAttribute("aria-label", description);
  return make("figure", {}, make("figcaption", {}, title), drawing, key);
}

function legend(labels) {
  const sample = (k) => make("svg", { width: 28, height: 10, "aria-hidden": "true" },
    make("line", { x1: 0, x2: 28, y1: 5, y2: 5, style: `stroke:${colour(k)}`, "stroke-width": 2.5, "stroke-dasharray": DASHES[k % 8] }));
  return make("ul", { class: "key" }, ...labels.map((label, k) => make("li", {}, sample(k), label)));
}

/** Round numbers that cover [low, high]. */
function ticks(low, high, count = 5) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((m) => m * power >= raw);
  const out = [];
  for (let x = Math.ceil(low / step - 1e-9) * step; x <= high + 1e-9; x += step) out.push(+x.toFixed(10));
  return out;
}

/** Axes of a chart: the frame, and the functions that place values in it. */
function chart(width, height, [x0, x1], [y0, y1], xTitle, yTitle) {
  const box = { left: 44, right: width - 10, top: 8, bottom: height - 36 };
  const x = (v) => box.left + ((v - x0) / (x1 - x0)) * (box.right - box.left);
  const y = (v) => box.bottom - ((v - y0) / (y1 - y0)) * (box.bottom - box.top);
  const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, width, height });
  for (const v of ticks(x0, x1)) svg.append(make("line", { class: "axis", x1: x(v), x2: x(v), y1: box.top, y2: box.bottom }),
    make("text", { class: "tick", x: x(v), y: box.bottom + 14, "text-anchor": "middle" }, `${v}`));
  for (const v of ticks(y0, y1)) svg.append(make("line", { class: "axis", x1: box.left, x2: box.right, y1: y(v), y2: y(v) }),
    make("text", { class: "tick", x: box.left - 5, y: y(v) + 4, "text-anchor": "end" }, `${v}`));
  svg.append(make("text", { x: (box.left + box.right) / 2, y: height - 4, "text-anchor": "middle" }, xTitle),
    make("text", { transform: `translate(11 ${(box.top + box.bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, yTitle));
  return { svg, x, y };
}

/** One column of a table: a dot and its interval for each row, the paper's values hollow. */
function intervals({ title, rows }) {
  const values = rows.flatMap((row) => [row.value, row.lo, row.hi].filter((v) => v !== null));
  let low = Math.min(...values), high = Math.max(...values);
  const pad = 0.06 * (high - low || 1);
  [low, high] = [low - pad, high + pad];
  const left = 150, width = 400, height = 22 * rows.length + 26;
  const x = (v) => left + ((v - low) / (high - low)) * (width - left - 12);
  const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, width, height });
  for (const v of ticks(low, high, 4)) svg.append(make("line", { class: "axis", x1: x(v), x2: x(v), y1: 0, y2: height - 20 }),
    make("text", { class: "tick", x: x(v), y: height - 5, "text-anchor": "middle" }, `${v}`));
  if (low < 0 && high > 0) svg.append(make("line", { x1: x(0), x2: x(0), y1: 0, y2: height - 20, style: "stroke:var(--faint)" }));
  rows.forEach((row, k) => {
    const y = 22 * k + 12, ink = row.paper ? "var(--paper)" : "var(--c0)";
    svg.append(make("text", { x: left - 8, y: y + 4, "text-anchor": "end" }, row.paper ? `${row.label}, paper` : row.label));
    if (row.lo !== null) svg.append(make("line", { x1: x(row.lo), x2: x(row.hi), y1: y, y2: y, style: `stroke:${ink}`, "stroke-width": 2 }));
    svg.append(make("circle", { cx: x(row.value), cy: y, r: 4, style: `stroke:${ink};fill:${row.paper ? "var(--back)" : ink}`, "stroke-width": 2 }));
  });
  const told = rows.map((r) => `${r.label}${r.paper ? " (paper)" : ""} ${r.value.toFixed(1)}` + (r.lo === null ? "" : ` [${r.lo.toFixed(1)}, ${r.hi.toFixed(1)}]`));
  return figure(title, `${title}: ${told.join("; ")}`, svg);
}

/** Success in bins of the episodes, a line for each run. */
function bins({ title, unit, edges, runs }) {
  const { svg, x, y } = chart(520, 300, [edges[0], edges.at(-1)], [0, 100], `${title}, ${unit}`, "success, %");
  const told = [];
  Object.entries(runs).forEach(([name, cells], k) => {
    const shown = cells.map((cell, i) => ({ ...cell, at: (edges[i] + edges[i + 1]) / 2 + (k - Object.keys(runs).length / 2) * 0.012 * (edges.at(-1) - edges[0]) })).filter((cell) => cell.n);
    const style = `stroke:${colour(k)};fill:none`;
    svg.append(make("path", { d: shown.map((c, i) => `${i ? "L" : "M"}${x(c.at)} ${y(c.rate)}`).join(""), style, "stroke-width": 2, "stroke-dasharray": DASHES[k % 8] }));
    for (const c of shown) svg.append(make("line", { x1: x(c.at), x2: x(c.at), y1: y(c.lo), y2: y(c.hi), style }),
      make("circle", { cx: x(c.at), cy: y(c.rate), r: 3, style: `fill:${colour(k)}` }));
    if (shown.length) told.push(`${name} ${shown.map((c) => percent(c.rate)).join(", ")}`);
  });
  return figure(`Success by ${title}`, `Success within 120 s by ${title}, bins ${edges.join(", ")} ${unit}. ${told.join("; ")}`, svg, legend(Object.keys(runs)));
}

/** Success while training over steps; a line is a training seed. */
function curves({ title, arms }) {
  const last = Math.max(...arms.flatMap((arm) => arm.seeds.map((seed) => seed.steps.at(-1))));
  const { svg, x, y } = chart(520, 300, [0, last], [0, 100], "million steps", "success, %");
  arms.forEach((arm, k) => arm.seeds.forEach((seed) => {
    const points = seed.steps.map((s, i) => [s, seed.success[i]]).filter(([, v]) => v !== null);
    svg.append(make("path", { d: points.map(([s, v], i) => `${i ? "L" : "M"}${x(s).toFixed(1)} ${y(v).toFixed(1)}`).join(""),
      style: `stroke:${colour(k)};fill:none`, "stroke-width": 1.7, "stroke-dasharray": DASHES[k % 8] }));
  }));
  const told = arms.map((arm) => `${arm.label} ends at ${arm.seeds.map((seed) => percent(seed.success.at(-1) ?? 0)).join(", ")}`);
  return figure(title, `${title}: ${told.join("; ")}`, svg, legend(arms.map((arm) => arm.label)));
}

for (const place of document.querySelectorAll("[data-intervals]"))
  place.append(...data.intervals.filter((column) => column.table === place.dataset.intervals).map(intervals));
document.querySelector("#curves .figures")?.append(...data.curves.map(curves));
document.querySelector("#difficulty .figures")?.append(...data.bins.map(bins));

const provenance = document.getElementById("provenance");
const facts = (of) => make("dl", {}, ...Object.entries(of).filter(([, v]) => v !== null).flatMap(([k, v]) => [make("dt", {}, k.replaceAll("_", " ")), make("dd", {}, `${v}`)]));
document.addEventListener("click", ({ target }) => {
  const button = target.closest?.("button.number");
  if (!button) return;
  provenance.querySelector("h2").textContent = `${button.dataset.name}: ${button.textContent}`;
  provenance.querySelector("div").replaceChildren(facts(JSON.parse(button.dataset.facts)),
    ...button.dataset.source.split(" ").map((k) => facts(data.sources[k])));
  provenance.showModal();
});
