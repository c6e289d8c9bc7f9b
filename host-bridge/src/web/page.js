"use strict";
// Asks the daemon for its numbers as often as it has new ones, and draws them. Nothing is sent, nothing is fetched from elsewhere.

const $ = (id) => document.getElementById(id);
let ring = null;      // names and places, asked once
let chosen = null;    // name of the var of the history
let last = null;      // the last numbers, each with its name and place
let failed = 0;       // how often in a row the daemon did not reply

// A node as it is wanted, with text or other nodes inside. Less than a tenth of a pixel is not seen.
function node(name, attributes = {}, inside = []) {
  for (const key in attributes) if (typeof attributes[key] === "number") attributes[key] = Math.round(10 * attributes[key]) / 10;
  return { name, attributes, inside };
}

// The nodes in a parent are made once; later only what differs is set.
function fill(parent, wanted) {
  const nodes = wanted.filter(Boolean);
  let there = parent.firstElementChild;
  for (const each of nodes) {
    if (there?.localName !== each.name) {
      const made = document.createElementNS(each.name === "svg" ? "http://www.w3.org/2000/svg" : parent.namespaceURI, each.name);
      if (there) there.replaceWith(made); else parent.append(made);
      there = made;
    }
    update(there, each);
    there = there.nextElementSibling;
  }
  while (parent.childElementCount > nodes.length) parent.lastElementChild.remove();
}

function update(there, { attributes, inside }) {
  const before = there.wanted ?? { attributes: {} };
  for (const key in attributes) if (attributes[key] !== before.attributes[key]) there.setAttribute(key, attributes[key]);
  for (const key in before.attributes) if (!(key in attributes)) there.removeAttribute(key);
  if (Array.isArray(inside)) fill(there, inside);
  else if (inside !== before.inside) there.textContent = inside;
  there.wanted = { attributes, inside };
}

const picture = (width, height, label, inside) => node("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label }, inside);
const span = (seconds) => seconds < 1 ? `${Math.round(1e3 * seconds)} ms` : seconds < 120 ? `${Math.round(seconds)} s` : seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
const micro = (us) => us < 1000 ? `${us} µs` : `${(us / 1000).toFixed(1)} ms`;
const fixed = (number, digits) => number == null ? "–" : number.toFixed(digits);
const count = (number) => Number(number).toLocaleString("en-GB").replaceAll(",", " ");
const kind = ({ mean, sigma }) => Math.abs(mean - 1) < 2 * sigma ? "usual" : mean < 1 ? "weak" : "strong";
const inWords = ({ name, mean, sigma }) => `${name}: ${mean.toFixed(4)} ± ${sigma.toFixed(4)}`;
const isKnown = ({ mean, sigma }) => mean !== null && sigma !== null;
const isOk = ({ state }) => state === "ok";
const width = (id) => Math.max(300, Math.round($(id).clientWidth || 560));

// Round steps between two ends, about so many.
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((v) => v * power).find((v) => v >= rough);
  const all = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) all.push(Number((i * step).toPrecision(12)));
  return all;
}

// Labels that cover none of those before them.
function clear(labels) {
  const kept = [];
  for (const label of labels) {
    const isFree = (other) => Math.abs(other.x - label.x) >= (other.wide + label.wide) / 2 || Math.abs(other.y - label.y) >= (other.high + label.high) / 2;
    if (kept.every(isFree)) kept.push(label);
  }
  return kept;
}

function verdict(state) {
  const say = (kind, words) => update($("verdict"), node("p", { class: kind }, words));
  if (failed > 2) return say("bad", "The daemon does not reply: it has ended, or the connection to it is broken. What follows is old.");
  if (!state.vars) return say("waits", "Waiting for the first estimate.");
  if (state.age_s > 10) return say("bad", `No estimate for ${span(state.age_s)}: no frames come. What follows is old.`);
  if (state.mismatch) return say("bad", "Readings and model disagree by more than noise explains: do not act on these numbers. `orbitcal diagnose` says what the model may lack.");
  if (!state.usable) return say("bad", `The last estimate is not usable${state.remarks.length ? ` (${state.remarks.join(", ")})` : ""}.`);
  say("good", "Readings and model agree; the estimate is usable.");
}

function numbers(state) {
  const lost = state.faults.dropped;
  const all = [
    ["frames a second", fixed(state.rate_hz, state.rate_hz >= 100 ? 0 : 1)],
    ["age of the estimate", state.age_s === null ? "–" : span(state.age_s), state.age_s > 10],
    ["frame to estimate, median", state.latency_us ? micro(state.latency_us[0]) : "–"],
    ["of 99 %, within", state.latency_us ? micro(state.latency_us[1]) : "–"],
    ["chi² per degree of freedom", state.chi_square != null && state.degrees_of_freedom > 0 ? (state.chi_square / state.degrees_of_freedom).toFixed(3) : "–", state.mismatch],
    ["frames in the estimate", state.frames === undefined ? "–" : count(state.frames)],
    ["frames waiting", count(state.queue)],
    ["frames dropped", count(lost), lost > 0],
  ];
  fill($("numbers"), all.map(([name, value, bad]) => node("div", { class: bad ? "bad" : "" }, [node("dt", {}, name), node("dd", {}, value)])));
}

// Vars as rows, in as many columns as there is room for, all on one scale, which stays above them.
function vars(state, wide) {
  const columns = Math.max(1, Math.min(3, Math.floor(wide / 190)));
  const rows = Math.ceil(state.vars.length / columns), line = 15, top = 18;
  const reach = Math.max(0.02, ...state.vars.filter(isKnown).map(({ mean, sigma }) => Math.min(0.2, Math.abs(mean - 1) + 2 * sigma)));
  const column = wide / columns, left = 9 * Math.max(...state.vars.map(({ name }) => name.length)) + 6, right = 10;
  const at = (c, value) => c * column + left + (column - left - right) * (0.5 + 0.5 * Math.max(-1, Math.min(1, (value - 1) / reach)));
  const scale = Array.from({ length: columns }, (_, c) => ticks(1 - reach, 1 + reach, 5).map((tick) => ({ tick, x: at(c, tick) }))).flat();
  const grid = (y1, y2) => scale.map(({ tick, x }) => node("line", { class: tick === 1 ? "nominal" : "axis", x1: x, x2: x, y1, y2 }));
  const links = state.vars.map((each, i) => {
    const { name, mean, sigma } = each, look = kind(each), c = Math.floor(i / rows), y = (i % rows) * line + line / 2;
    return isKnown(each) && node("a", { class: name === chosen ? "chosen" : "", tabindex: 0, role: "button", "data-var": name }, [
      node("title", {}, inWords(each)),
      node("rect", { class: "pick", x: c * column, y: y - line / 2, width: column - 4, height: line }),
      node("text", { x: c * column + 4, y: y + 4 }, name),
      node("line", { class: look, x1: at(c, mean - 2 * sigma), x2: at(c, mean + 2 * sigma), y1: y, y2: y, "stroke-width": 1 }),
      node("line", { class: look, x1: at(c, mean - sigma), x2: at(c, mean + sigma), y1: y, y2: y, "stroke-width": 4 }),
      node("circle", { class: look, cx: at(c, mean), cy: y, r: 3 }),
    ]);
  });
  fill($("vars"), [
    picture(wide, top, "Scale", [...grid(top - 3, top), ...scale.map(({ tick, x }) => node("text", { class: "pale", x, y: 11, "text-anchor": "middle" }, tick))]),
    picture(wide, rows * line + 4, "Strength factors against nominal", [...grid(0, rows * line), ...links]),
  ]);
}

// Where many marks share a circle they are smaller, and correctors lie on several circles.
function map(state, wide) {
  const size = Math.min(wide, 560), middle = size / 2, radius = 0.33 * size;
  const at = (s, r) => { const angle = 2 * Math.PI * s / ring.place.circumference; return [middle + r * Math.sin(angle), middle - r * Math.cos(angle)]; };
  const pitch = (spots, r) => 2 * Math.PI * r / new Set(spots.flatMap(({ s }) => s)).size;
  const known = state.vars.filter(isKnown), thick = Math.min(4, 0.7 * pitch(state.vars, radius));
  const reach = Math.max(0.02, ...known.map(({ mean }) => Math.abs(mean - 1)));
  const bars = known.flatMap((each) => each.s.map((s) => {
    const [x1, y1] = at(s, radius), [x2, y2] = at(s, radius * (1 + 0.2 * (each.mean - 1) / reach));
    return node("line", { class: kind(each), x1, y1, x2, y2, "stroke-width": thick }, [node("title", {}, inWords(each))]);
  }));
  const dot = Math.min(2.5, 0.4 * pitch(state.monitors, 1.22 * radius)), dense = pitch(state.correctors, 0.78 * radius);
  const circles = Math.ceil(3 / dense), triangle = Math.min(2.5, 0.4 * circles * dense);
  const look = (each, r) => ({ class: isOk(each) ? "usual hollow" : "faulty", r: isOk(each) ? r : Math.max(3, 2 * r), "stroke-width": r / 2.5 });
  const title = ({ name, state }) => [node("title", {}, `${name}: ${state}`)];
  const dots = state.monitors.map((each) => {
    const [cx, cy] = at(each.s[0], radius * (each.name.startsWith("y") ? 1.27 : 1.22));
    return node("circle", { ...look(each, dot), cx, cy }, title(each));
  });
  const triangles = state.correctors.map((each, i) => {
    const [x, y] = at(each.s[0], (0.78 - 0.04 * (i % circles)) * radius), { r, ...rest } = look(each, triangle);
    return node("path", { ...rest, d: `M${x} ${y - r}L${x + r} ${y + r}L${x - r} ${y + r}Z` }, title(each));
  });
  // outside of its mark, on either side
  const label = ({ name, s }, r) => {
    const [x, y] = at(s[0], r), aside = (x - middle) / r * Math.sign(r - radius), side = Math.abs(aside) < 0.4 ? 0 : Math.sign(aside), wide = 7 * name.length;
    return { name, side, end: x, x: x + side * wide / 2, y, wide, high: 12 };
  };
  const centre = { x: middle, y: middle, wide: 60, high: 40 };
  const labels = (instruments, r) => instruments.filter((each) => !isOk(each)).map((each) => label(each, r * radius));
  const ill = [...labels(state.monitors, 1.36), ...labels(state.correctors, 0.7 - 0.04 * circles)];
  const names = clear([centre, ...ill]).slice(1).map(({ name, side, end, y }) => node("text", { x: end, y: y + 4, "text-anchor": ["end", "middle", "start"][side + 1], class: "pale" }, name));
  fill($("ring"), [picture(size, size, "The ring", [
    node("circle", { class: "axis", cx: middle, cy: middle, r: radius }),
    ...bars, ...dots, ...triangles, ...names,
    node("text", { x: middle, y: middle - 4, "text-anchor": "middle" }, `${ring.place.circumference.toFixed(1)} m`),
    node("text", { x: middle, y: middle + 14, "text-anchor": "middle", class: "pale" }, ill.length ? `${ill.length} not ok` : "all instruments ok"),
  ])]);
}

// In as many rows as make each bar wide enough to point at. Where labels have no room, every second or fifth has one, and those not ok come first.
function residuals(state, wide) {
  const left = 40, right = 8, long = wide - left - right;
  const rows = Math.ceil(3 * state.monitors.length / long), columns = Math.ceil(state.monitors.length / rows), step = long / columns;
  const [top, high] = rows > 1 ? [20, 100] : [8, 190], bottom = Math.max(44, 7 * Math.max(...state.monitors.map(({ name }) => name.length)) + 10);
  const shown = state.monitors.flatMap((each) => [2 * each.noise_mm, each.use === "used" ? Math.abs(each.residual_mm) : 0]);
  const reach = 1.1 * Math.max(0.01, ...shown), down = (mm) => high / 2 * (1 - Math.max(-1, Math.min(1, mm / reach)));
  const tops = Array.from({ length: rows }, (_, row) => top + row * (high + bottom));
  const grid = tops.flatMap((top) => ticks(-reach, reach, 4).flatMap((tick) => [
    node("line", { class: tick === 0 ? "nominal" : "axis", x1: left, x2: wide - right, y1: top + down(tick), y2: top + down(tick) }),
    node("text", { class: "pale", x: left - 5, y: top + down(tick) + 4, "text-anchor": "end" }, tick),
  ]));
  const isTight = step >= 8 && step < 11, gap = isTight ? 8 : 11, every = [1, 2, 5].find((n) => n * step >= gap);
  const spots = state.monitors.map((each, i) => ({ ...each, x: left + (i % columns + 0.5) * step, y: tops[Math.floor(i / columns)], wide: gap, high: 1 }));
  const labelled = new Set(clear([...spots.filter((spot) => !isOk(spot)), ...spots.filter((_, i) => i % every === 0)]));
  const bars = spots.map((spot) => {
    const { name, use, noise_mm, residual_mm, x, y } = spot, look = isOk(spot) ? "usual" : "faulty";
    const [from, to] = [Math.min(down(0), down(residual_mm)), Math.max(down(0), down(residual_mm))];
    return node("g", {}, [
      node("title", {}, `${name}: ${residual_mm === null ? use : `${residual_mm.toFixed(3)} mm, ${use}`}, noise ${fixed(noise_mm, 3)} mm, ${spot.state}`),
      noise_mm !== null && node("rect", { class: "band", x: x - step / 2, width: step, y: y + down(2 * noise_mm), height: down(-2 * noise_mm) - down(2 * noise_mm) }),
      residual_mm !== null && node("rect", { class: use === "used" ? look : `${look} hollow`, x: x - 0.3 * step, width: 0.6 * step, y: y + from, height: Math.max(1, to - from) }),
      labelled.has(spot) && node("text", { transform: `translate(${x + 4} ${y + high + 6}) rotate(-90)`, "text-anchor": "end", class: `${isOk(spot) ? "pale" : "faulty"}${isTight ? " small" : ""}` }, name),
    ]);
  });
  fill($("residuals"), [picture(wide, top + rows * (high + bottom), "Readings less what the estimate expects", [...grid, node("text", { class: "pale", x: 2, y: 12 }, "mm"), ...bars])]);
}

const percent = (share) => `${Math.round(100 * share)} %`;
function unwell(state) {
  const seen = {
    noisy: (r) => `scatters ${fixed(r[0], 1)} times as much as expected`,
    jumps: (r) => `${percent(r[1])} of its frames are far off`,
    dead: (r) => `missing, stuck or without effect in ${percent(r[2])} of its frames`,
    back: () => "its fault has ended a short while ago",
  };
  const [monitors, correctors] = [state.monitors, state.correctors].map((all) => `${all.filter(isOk).length} of ${all.length}`);
  const rows = [...state.monitors, ...state.correctors].filter((each) => !isOk(each)).map(({ name, state, ratios }) => [name, state, ratios ? seen[state](ratios) : ""]);
  $("healthy").textContent = `${monitors} monitors and ${correctors} correctors are ok.`;
  $("unwell").hidden = rows.length === 0;
  table("unwell", rows);
}

function table(id, rows, bad = () => false) {
  const cell = (text, i) => node("td", { class: i > 0 && typeof text === "number" ? "number" : "" }, text);
  fill($(id).tBodies[0], rows.map((cells) => node("tr", { class: bad(cells) ? "bad" : "" }, cells.map(cell))));
}

function faults(state) {
  const f = state.faults;
  const rows = [["frames dropped from a full buffer", f.dropped], ["packets damaged", f.damaged], ["frames refused by the core", f.refused], ["frames put aside: without beam, or with one that the model does not know", state.put_aside ?? 0], ["connections lost", f.disconnected], ["checkpoints not saved", f.unsaved], ["rows of the history not written", state.history_rows_lost]];
  table("faults", rows, ([, number]) => number > 0);
}

async function trail() {
  const name = chosen, over = $("span").value, wide = width("trail"), left = 50, right = 10, top = 24, high = 180, bottom = 24;
  const found = await reply(`/trail.json?span=${over}&var=${encodeURIComponent(name)}`).catch(() => null);
  if (!found || name !== chosen || over !== $("span").value) return;
  const points = found.points.map(([time, mean, sigma, , mismatch]) => ({ time, mean, sigma, mismatch })).filter(isKnown);
  const long = { hour: 36e5, day: 864e5, month: 2592e6 }[over], now = Date.now();
  const from = Math.max(now - long, points.length ? Math.min(points[0].time, now - long / 60) : 0);
  const low = Math.min(1, ...points.map(({ mean, sigma }) => mean - 2 * sigma)), most = Math.max(1, ...points.map(({ mean, sigma }) => mean + 2 * sigma));
  const pad = 0.05 * (most - low) || 0.01, x = (time) => left + (wide - left - right) * (time - from) / (now - from), y = (value) => top + high * (most + pad - value) / (most - low + 2 * pad);
  const grid = ticks(low - pad, most + pad, 4).flatMap((tick) => [
    node("line", { class: tick === 1 ? "nominal" : "axis", x1: left, x2: wide - right, y1: y(tick), y2: y(tick) }),
    node("text", { class: "pale", x: left - 5, y: y(tick) + 4, "text-anchor": "end" }, tick),
  ]);
  const clock = new Intl.DateTimeFormat("en-GB", over === "month" ? { day: "numeric", month: "short" } : { hour: "2-digit", minute: "2-digit" });
  const times = [0, 1, 2, 3, 4].map((i) => from + (now - from) * i / 4);
  const hours = times.map((time, i) => node("text", { class: "pale", x: x(time), y: top + high + 16, "text-anchor": i === 0 ? "start" : i === 4 ? "end" : "middle" }, clock.format(time)));
  const line = (points, value) => points.map((point) => `${x(point.time).toFixed(1)} ${y(value(point)).toFixed(1)}`).join("L");
  const newest = points.at(-1);
  const curve = newest ? [
    node("path", { class: "area", d: `M${line(points, ({ mean, sigma }) => mean + 2 * sigma)}L${line([...points].reverse(), ({ mean, sigma }) => mean - 2 * sigma)}Z` }),
    node("path", { class: "curve", d: `M${line(points, ({ mean }) => mean)}` }),
    ...points.filter(({ mismatch }) => mismatch).map(({ time }) => node("line", { class: "faulty", x1: x(time), x2: x(time), y1: top + high - 6, y2: top + high })),
    node("circle", { class: "weak", cx: x(newest.time), cy: y(newest.mean), r: 3 }),
    node("text", { x: left, y: 12 }, `${inWords({ name, ...newest })}; the band is two error bars`),
  ] : [node("text", { x: left, y: 12, class: "pale" }, "no estimates in this time")];
  fill($("trail"), [picture(wide, top + high + bottom, `History of ${name}`, [...grid, ...hours, ...curve])]);
}

function choose(name) {
  chosen = $("var").value = name;
  draw();
  trail();
}

function draw() {
  // asked before anything changes, widths cost no layout of their own
  const widths = ["vars", "ring", "residuals"].map(width);
  verdict(last ?? {});
  if (!last) return;
  numbers(last);
  faults(last);
  if (!last.vars) return;
  [vars, map, residuals].forEach((show, i) => show(last, widths[i]));
  unwell(last);
}

const reply = async (path) => (await fetch(path, { signal: AbortSignal.timeout(3000) })).json();

async function begin() {
  ring = await reply("/ring.json");
  $("machine").textContent = document.title = ring.place.machine;
  $("publisher").textContent = `published by ${ring.publisher}`;
  chosen = ring.place.vars[0]?.name;
  $("var").replaceChildren(...ring.place.vars.map(({ name }) => new Option(name)));
}

// The numbers, each with its name and place.
function named(state) {
  if (!state.vars) return state;
  const instruments = (kind) => ring.place[kind].map((spot, i) => ({ ...spot, state: "ok", ...state[kind][i] }));
  const vars = ring.place.vars.map((spot, i) => ({ ...spot, mean: state.vars[i][0], sigma: state.vars[i][1] }));
  return { ...state, vars, monitors: instruments("monitors"), correctors: instruments("correctors") };
}

// From one question to the next [ms]: soon after the next estimate where ten come a second, rarely where none comes.
function pause() {
  if (failed || document.hidden || last.shown_s_ago === undefined) return 1000;
  const age = 1000 * last.shown_s_ago;
  return Math.min(1000, Math.max(120 - age, age / 3));
}

async function look() {
  const asked = performance.now();
  try {
    if (!ring) await begin();
    const state = await reply("/state.json");
    // the daemon may have begun anew with another ring
    if (state.vars && state.vars.length !== ring.place.vars.length) await begin();
    last = named(state);
    failed = 0;
  } catch {
    failed += 1;
  }
  setTimeout(look, asked + pause() - performance.now());
  draw();
}

for (const event of ["click", "keydown"]) {
  $("vars").addEventListener(event, ({ target, key = "Enter" }) => {
    const link = target.closest("a");
    if (link && key === "Enter") choose(link.dataset.var);
  });
}
$("var").addEventListener("change", () => choose($("var").value));
$("span").addEventListener("change", trail);
addEventListener("resize", () => { draw(); trail(); });
look().then(trail);
setInterval(trail, 10_000);
