"use strict";
/** Replays: the ways of the arms on the storeys that they saw, over time. */
const replay = document.getElementById("replay");
const unpacked = new Map();

/** Whole numbers of a packed table, column by column; what `pack` in episodes.py wrote. */
async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Int16Array(await new Response(stream).arrayBuffer());
}

/** Ways of one run, by episode: {x, y, z, yaw, contact} in m and rad. */
async function ways(name) {
  if (!unpacked.has(name)) unpacked.set(name, (async () => {
    const { first, steps, columns } = data.ways[name];
    const flat = await unpack(steps), n = first.at(-1), out = {};
    columns.forEach((column, k) => {
      const values = new Float32Array(n);
      for (let i = 0, sum = 0; i < n; i++) values[i] = (sum += flat[k * n + i]) / 100;
      out[column] = values;
    });
    return (episode) => Object.fromEntries(columns.map((column) => [column, out[column].subarray(first[episode], first[episode + 1])]));
  })());
  return unpacked.get(name);
}

const image = (source) => new Promise((done) => {
  const picture = new Image();
  picture.onload = () => done(picture);
  picture.src = `data:image/png;base64,${source}`;
});

const player = { episode: 0, runs: [], hidden: new Set(), storeys: [], shortest: null, span: 1, time: 0, playing: false, asked: 0 };
/** Time goes in steps of the shortest period, s; a run has a sample in every one of its own. */
const period = Math.min(...Object.values(data.periods ?? {}));
const sample = (run) => Math.min(Math.round((player.time * period) / data.periods[run.name]), run.way.x.length - 1);
const nearest = (layers, z) => layers.reduce((best, layer, k) => (Math.abs(layer - z) < Math.abs(layers[best] - z) ? k : best), 0);

async function openReplay(episode) {
  const asked = ++player.asked;
  const tile = data.tiles[episodes.tile[episode]];
  const names = Object.keys(data.results);
  const found = await Promise.all(names.map(async (name) => ({ name, way: (await ways(name))(episode) })));
  const shortest = (await ways("shortest"))(episode);
  const ends = [episodes.start[episode], episodes.goal[episode]];
  const on = (way) => Array.from(way.z, (z) => nearest(tile.layers, z));
  const runs = found.map((run) => ({ ...run, layer: on(run.way), colour: names.indexOf(run.name) }));
  const layers = [...new Set([...runs.flatMap((run) => run.layer), ...ends.map((end) => nearest(tile.layers, end[2]))])].sort((a, b) => a - b);
  const pictures = await Promise.all(layers.map((layer) => image(tile.images[layer])));
  if (asked !== player.asked) return; // another one was asked for in the meantime
  const xs = [...ends.map((end) => end[0]), ...[...runs.map((run) => run.way), shortest].flatMap((way) => [...way.x])];
  const ys = [...ends.map((end) => end[1]), ...[...runs.map((run) => run.way), shortest].flatMap((way) => [...way.y])];
  const side = Math.min(tile.side, Math.max(12, Math.max(...xs) - Math.min(...xs) + 5, Math.max(...ys) - Math.min(...ys) + 5));
  const corner = [xs, ys].map((v) => Math.min(Math.max((Math.min(...v) + Math.max(...v) - side) / 2, 0), tile.side - side));
  Object.assign(player, { episode, tile, runs, shortest: { way: shortest, layer: on(shortest) }, ends, side, corner, time: 0 });
  player.span = Math.max(...runs.map((run) => Math.ceil(((run.way.x.length - 1) * data.periods[run.name]) / period - 1e-6)), 1);
  player.storeys = layers.map((layer, k) => ({ layer, picture: pictures[k], canvas: make("canvas", { width: 640, height: 640, role: "img" }) }));
  replay.querySelector(".storeys").replaceChildren(...player.storeys.map(({ layer, canvas }) => make("figure", {}, make("figcaption", {}, tile.names[layer]), canvas)));
  replay.querySelector(".runs").replaceChildren(...runs.map((run) => make("label", {},
    make("input", { type: "checkbox", ...(player.hidden.has(run.name) ? {} : { checked: "" }), input: ({ target }) => { target.checked ? player.hidden.delete(run.name) : player.hidden.add(run.name); draw(); } }),
    make("span", { style: `color:${colour(run.colour)};font-weight:600` }, ` ${run.name} `), make("output", { "data-run": run.name }))));
  document.getElementById("replay-title").textContent = `Episode ${episode}: ${episodes.kind[episode]} ${episodes.tile[episode]}, ${episodes.geodesic[episode].toFixed(1)} m, climb ${episodes.climb[episode].toFixed(1)} m`;
  document.getElementById("time").max = player.span;
  if (!replay.open) replay.showModal();
  seek(0);
  play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
}

function seek(time) {
  player.time = Math.min(time, player.span);
  document.getElementById("time").value = Math.round(player.time);
  const seconds = (Math.round(player.time) * period).toFixed(1);
  document.getElementById("clock").textContent = `${seconds} s`;
  document.getElementById("time").setAttribute("aria-valuetext", `${seconds} s`);
  draw();
}

let last = 0;
function play(on) {
  player.playing = on;
  document.getElementById("play").textContent = on ? "Pause" : "Play";
  if (on) requestAnimationFrame((now) => { last = now; requestAnimationFrame(tick); });
}
function tick(now) {
  if (!player.playing || !replay.open) return;
  seek(player.time + ((now - last) / 1000 / period) * document.getElementById("speed").value);
  last = now;
  player.time < player.span ? requestAnimationFrame(tick) : play(false);
}

function draw() {
  const ink = getComputedStyle(document.documentElement);
  const tone = (name) => ink.getPropertyValue(name).trim();
  for (const { layer, picture, canvas } of player.storeys) {
    const g = canvas.getContext("2d"), scale = canvas.width / player.side, { tile, corner, side } = player;
    const x = (v) => (v - corner[0]) * scale, y = (v) => canvas.height - (v - corner[1]) * scale;
    g.clearRect(0, 0, canvas.width, canvas.height);
    g.imageSmoothingEnabled = false;
    const pixels = picture.width / tile.side;
    g.drawImage(picture, corner[0] * pixels, (tile.side - corner[1] - side) * pixels, side * pixels, side * pixels, 0, 0, canvas.width, canvas.height);
    const line = (way, layers, until, style, dash) => {
      g.beginPath();
      for (let i = 0, pen = false; i <= until; i++) {
        if (layers[i] !== layer) { pen = false; continue; }
        pen ? g.lineTo(x(way.x[i]), y(way.y[i])) : g.moveTo(x(way.x[i]), y(way.y[i]));
        pen = true;
      }
      Object.assign(g, { strokeStyle: style, lineWidth: 3 });
      g.setLineDash(dash);
      g.stroke();
      g.setLineDash([]);
    };
    line(player.shortest.way, player.shortest.layer, player.shortest.layer.length - 1, tone("--faint"), [8, 8]);
    player.ends.forEach((end, k) => {
      if (nearest(tile.layers, end[2]) !== layer) return;
      g.fillStyle = tone("--text");
      g.beginPath();
      if (k === 0) g.arc(x(end[0]), y(end[1]), 7, 0, 7);
      else for (let i = 0; i < 10; i++) g.lineTo(x(end[0]) + (i % 2 ? 5 : 12) * Math.sin(0.2 * Math.PI * i), y(end[1]) - (i % 2 ? 5 : 12) * Math.cos(0.2 * Math.PI * i));
      g.fill();
    });
    const here = [];
    for (const run of player.runs) {
      if (player.hidden.has(run.name)) continue;
      const at = sample(run);
      line(run.way, run.layer, at, tone(`--c${run.colour % 8}`), []);
      if (run.layer[at] !== layer) continue;
      here.push(run.name);
      g.save();
      g.translate(x(run.way.x[at]), y(run.way.y[at]));
      g.rotate(-run.way.yaw[at]);
      g.beginPath();
      g.moveTo(14, 0); g.lineTo(-9, 8); g.lineTo(-5, 0); g.lineTo(-9, -8); g.closePath();
      Object.assign(g, { fillStyle: run.way.contact[at] ? "#d22" : tone(`--c${run.colour % 8}`), strokeStyle: tone("--back"), lineWidth: 2 });
      g.fill(); g.stroke();
      g.restore();
    }
    canvas.setAttribute("aria-label", `Map of ${tile.names[layer]}; here: ${here.join(", ") || "no robot"}`);
  }
  for (const run of player.runs) {
    const at = sample(run), result = data.results[run.name], k = player.episode;
    const end = at < run.way.x.length - 1 ? "" : result.success_time[k] === null ? ` (${result.where[k]}, ${result.how[k]})` : " (reached)";
    replay.querySelector(`output[data-run="${CSS.escape(run.name)}"]`).textContent = `${(at * data.periods[run.name]).toFixed(0)} s, height ${run.way.z[at].toFixed(1)} m${end}`;
  }
}

document.getElementById("play").addEventListener("click", () => { if (!player.playing && player.time >= player.span) seek(0); play(!player.playing); });
document.getElementById("time").addEventListener("input", ({ target }) => { play(false); seek(+target.value); });
const step = (by) => { const at = list.order.indexOf(player.episode) + by; if (list.order[at] !== undefined) openReplay(list.order[at]); };
document.getElementById("previous").addEventListener("click", () => step(-1));
document.getElementById("next").addEventListener("click", () => step(1));
replay.addEventListener("close", () => play(false));
replay.addEventListener("keydown", (event) => {
  if (event.key === " " && event.target.tagName !== "BUTTON" && event.target.type !== "checkbox") { event.preventDefault(); document.getElementById("play").click(); }
});
