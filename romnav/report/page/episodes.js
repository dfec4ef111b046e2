"use strict";
/** The failures and the table of episodes; `list` holds the episodes that pass the filter, in their order. */
const episodes = data.episodes;
const list = { order: [], sort: "episode", down: false };

if (episodes) {
  const runs = Object.keys(data.results);
  const outcome = (run, k) => {
    const r = data.results[run];
    return r.success_time[k] === null ? `${r.where[k]}, ${r.how[k]}` : `${r.success_time[k].toFixed(0)} s`;
  };
  const columns = [
    { key: "episode", text: "episode", value: (k) => k },
    { key: "kind", text: "tile", value: (k) => `${episodes.kind[k]} ${episodes.tile[k]}` },
    { key: "level", text: "level", value: (k) => episodes.level[k] },
    { key: "geodesic", text: "length, m", value: (k) => episodes.geodesic[k], show: (v) => v.toFixed(1) },
    { key: "climb", text: "climb, m", value: (k) => episodes.climb[k], show: (v) => v.toFixed(1) },
    ...runs.map((run) => ({ key: `run ${run}`, text: run, run, value: (k) => data.results[run].success_time[k] ?? 1e3 })),
  ];

  // the filter: each control is a test of an episode
  const form = document.querySelector(".filters");
  const select = (name, options) => make("select", { name }, ...options.map(([value, text]) => make("option", { value }, text ?? value)));
  const field = (text, control) => make("label", {}, text, control);
  const any = ["", "any"];
  form.append(
    field("level", select("level", [any, ["same"], ["cross"]])),
    field("tile", select("kind", [any, ...[...new Set(episodes.kind)].sort().map((kind) => [kind])])),
    field("length at least, m", make("input", { name: "length", type: "number", min: 0 })),
    field("climb at least, m", make("input", { name: "climb", type: "number", min: 0, step: 0.5 })),
    field("arm", select("run", [...(runs.length > 1 ? [["", "every arm"]] : []), ...runs.map((run) => [run])])),
    field("outcome", select("outcome", [any, ["success"], ["failed"]])),
    field("got to", select("where", [any, ...data.where.map((w) => [w])])),
    field("in the end", select("how", [any, ...data.how.map((h) => [h])])),
    make("button", { type: "reset" }, "Clear"),
  );
  const passes = (k) => {
    const want = Object.fromEntries(new FormData(form));
    const chosen = want.run ? [want.run] : runs;
    return (!want.level || episodes.level[k] === want.level) && (!want.kind || episodes.kind[k] === want.kind)
      && episodes.geodesic[k] >= +want.length && episodes.climb[k] >= +want.climb
      && chosen.every((run) => {
        const r = data.results[run], solved = r.success_time[k] !== null;
        return (!want.outcome || (want.outcome === "success") === solved)
          && (!want.where || r.where[k] === want.where) && (!want.how || r.how[k] === want.how);
      });
  };

  const [head, body] = document.querySelector(".episodes").children;
  head.append(make("tr", {}, ...columns.map((column) => make("th", { scope: "col", "data-key": column.key },
    make("button", { type: "button", click: () => sort(column.key) }, column.text)))));
  const rows = episodes.tile.map((_, k) => make("tr", {}, ...columns.map((column) => {
    if (column.key === "episode") return make("td", {}, make("button", { type: "button", "aria-label": `Replay episode ${k}`, click: () => openReplay(k) }, `▶ ${k}`));
    if (column.run) return make("td", { class: data.results[column.run].success_time[k] === null ? "bad" : "good" }, outcome(column.run, k));
    const value = column.value(k);
    return make("td", {}, column.show ? column.show(value) : value);
  })));

  function refresh() {
    const column = columns.find(({ key }) => key === list.sort), sign = list.down ? -1 : 1;
    const keyed = rows.map((_, k) => k).filter(passes).map((k) => [column.value(k), k]);
    keyed.sort(([a, i], [b, j]) => (a < b ? -sign : a > b ? sign : i - j));
    list.order = keyed.map(([, k]) => k);
    body.replaceChildren(...list.order.map((k) => rows[k]));
    for (const th of head.querySelectorAll("th"))
      th.setAttribute("aria-sort", th.dataset.key === list.sort ? (list.down ? "descending" : "ascending") : "none");
    document.getElementById("count").textContent = `${list.order.length} of ${rows.length} episodes`;
  }
  function sort(key) {
    list.down = list.sort === key && !list.down;
    list.sort = key;
    refresh();
  }
  form.addEventListener("input", refresh);
  form.addEventListener("reset", () => setTimeout(refresh));
  form.addEventListener("submit", (event) => event.preventDefault());

  // failures: a table for each run, its numbers filter the episodes
  const show = (run, where, how) => {
    form.reset();
    Object.entries({ run, where, how, outcome: "failed" }).forEach(([name, value]) => { form.elements[name].value = value; });
    refresh();
    document.getElementById("episodes").scrollIntoView();
    body.querySelector("button")?.focus({ preventScroll: true });
  };
  const count = (run, where, how) => data.results[run].where.filter((w, k) => w === where && data.results[run].how[k] === how).length;
  for (const run of runs) {
    const counts = data.where.map((where) => data.how.map((how) => count(run, where, how)));
    const most = Math.max(1, ...counts.flat());
    document.querySelector("#failures .figures").append(make("figure", {}, make("figcaption", {}, `${run}: ${counts.flat().reduce((a, b) => a + b, 0)} failed`),
      make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": `Failures of ${run}` }, make("table", {}, make("thead", {}, make("tr", {}, make("td"), ...data.how.map((how) => make("th", { scope: "col" }, how)))),
        make("tbody", {}, ...data.where.map((where, i) => make("tr", {}, make("th", { scope: "row" }, where), ...data.how.map((how, j) => {
          const n = counts[i][j];
          return make("td", { style: `background:color-mix(in srgb, ${colour(runs.indexOf(run))} ${Math.round((45 * n) / most)}%, transparent)` },
            n ? make("button", { type: "button", class: "count", "aria-label": `${n} episodes of ${run}: ${where}, ${how}`, click: () => show(run, where, how) }, `${n}`) : "");
        }))))))));
  }
  refresh();
}
