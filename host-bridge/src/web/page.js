"use strict";
// Asks the daemon once a second for its numbers, and draws them. Nothing is sent, nothing is fetched from elsewhere.

const $ = (id) => document.getElementById(id);
let ring = null;      // names and places, asked once
let chosen = null;    // name of the var of the history
let last = null;      // the last numbers
let failed = 0;       // how often in a row the daemon did not reply

const node = (name, attributes = {}, text) => {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
};
const picture = (width, height, says) => node("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": says });
const put = (id, svg) => $(id).replaceChildren(svg);
const span = (seconds) => seconds < 1 ? `${Math.round(1e3 * seconds)} ms` : seconds < 120 ? `${Math.round(seconds)} s` : seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
const micro = (us) => us < 1000 ? `${us} µs` : `${(us / 1000).toFixed(1)} ms`;
const count = (number) => Number(number).toLocaleString("en-GB").replaceAll(",", " ");
const kind = ([mean, sigma]) => Math.abs(mean - 1) < 2 * sigma ? "usual" : mean < 1 ? "weak" : "strong";
const width = (id) => Math.max(300, Math.round($(id).clientWidth || 560));

// Round steps between two ends, about so many.
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((v) => v * power).find((v) => v >= rough);
  const all = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) all.push(Number((i * step).toPrecision(12)));
  return all;
}

function verdict(state) {
  const stale = state.age_s !== null && state.age_s > 10;
  const say = (kind, words) => { $("verdict").className = kind; $("verdict").textContent = words; };
  if (failed > 2) return say("bad", "The daemon does not reply: it has ended, or the connection to it is broken. What follows is old.");
  if (!state.vars) return say("waits", "Waiting for the first estimate.");
  if (stale) return say("bad", `No estimate for ${span(state.age_s)}: no frames come. What follows is old.`);
  if (state.mismatch) return say("bad", "Readings and model disagree by more than noise explains: do not act on these numbers. `orbitcal diagnose` says what the model may lack.");
  if (!state.usable) return say("bad", `The last estimate is not usable${state.remarks.length ? ` (${state.remarks.join(", ")})` : ""}.`);
  say("good", "Readings and model agree; the estimate is usable.");
}

function numbers(state) {
  const lost = state.faults.dropped;
  const all = [
    ["frames a second", state.rate_hz == null ? "–" : state.rate_hz >= 100 ? Math.round(state.rate_hz) : state.rate_hz.toFixed(1)],
    ["age of the estimate", state.age_s === null ? "–" : span(state.age_s), state.age_s > 10],
    ["frame to estimate, median", state.latency_us ? micro(state.latency_us[0]) : "–"],
    ["of 99 %, within", state.latency_us ? micro(state.latency_us[1]) : "–"],
    ["chi² per degree of freedom", state.degrees_of_freedom > 0 ? (state.chi_square / state.degrees_of_freedom).toFixed(3) : "–", state.mismatch],
    ["frames in the estimate", state.frames === undefined ? "–" : count(state.frames)],
    ["frames waiting", count(state.queue)],
    ["frames dropped", count(lost), lost > 0],
  ];
  $("numbers").replaceChildren(...all.map(([name, value, bad]) => {
    const pair = document.createElement("div");
    const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
    [dt.textContent, dd.textContent, pair.className] = [name, value, bad ? "bad" : ""];
    pair.append(dt, dd);
    return pair;
  }));
}

// Vars as rows, in as many columns as there is room for, all on one scale.
function vars(state) {
  const names = ring.place.vars.map((spot) => spot.name);
  const wide = width("vars"), columns = Math.max(1, Math.min(3, Math.floor(wide / 190)));
  const rows = Math.ceil(names.length / columns), line = 15, top = 18;
  const reach = Math.max(0.02, ...state.vars.map(([mean, sigma]) => mean === null ? 0 : Math.min(0.2, Math.abs(mean - 1) + 2 * sigma)));
  const svg = picture(wide, top + rows * line + 4, "Strength factors against nominal");
  const column = wide / columns, left = 9 * Math.max(...names.map((name) => name.length)) + 6, right = 10;
  const at = (c, value) => c * column + left + (column - left - right) * (0.5 + 0.5 * Math.max(-1, Math.min(1, (value - 1) / reach)));
  for (let c = 0; c < columns; c++) {
    for (const tick of ticks(1 - reach, 1 + reach, 5)) {
      svg.append(node("line", { class: tick === 1 ? "nominal" : "axis", x1: at(c, tick), x2: at(c, tick), y1: top - 3, y2: top + rows * line }));
      svg.append(node("text", { class: "pale", x: at(c, tick), y: 11, "text-anchor": "middle" }, String(tick)));
    }
  }
  names.forEach((name, i) => {
    const [mean, sigma] = state.vars[i];
    if (mean === null) return;
    const c = Math.floor(i / rows), y = top + (i % rows) * line + line / 2, look = kind(state.vars[i]);
    const link = node("a", { class: name === chosen ? "chosen" : "", tabindex: 0, role: "button" });
    link.append(node("title", {}, `${name}: ${mean.toFixed(4)} ± ${sigma.toFixed(4)}`));
    link.append(node("rect", { class: "pick", x: c * column, y: y - line / 2, width: column - 4, height: line }));
    link.append(node("text", { x: c * column + 4, y: y + 4 }, name));
    link.append(node("line", { class: look, x1: at(c, mean - 2 * sigma), x2: at(c, mean + 2 * sigma), y1: y, y2: y, "stroke-width": 1 }));
    link.append(node("line", { class: look, x1: at(c, mean - sigma), x2: at(c, mean + sigma), y1: y, y2: y, "stroke-width": 4 }));
    link.append(node("circle", { class: look, cx: at(c, mean), cy: y, r: 3 }));
    const choose = () => { chosen = name; $("var").value = name; vars(last); trail(); };
    link.addEventListener("click", choose);
    link.addEventListener("keydown", (event) => { if (event.key === "Enter") choose(); });
    svg.append(link);
  });
  put("vars", svg);
}

function map(state) {
  const size = Math.min(width("ring"), 560), middle = size / 2, radius = 0.33 * size;
  const svg = picture(size, size, "The ring");
  const at = (s, r) => { const angle = 2 * Math.PI * s / ring.place.circumference; return [middle + r * Math.sin(angle), middle - r * Math.cos(angle)]; };
  svg.append(node("circle", { class: "axis", cx: middle, cy: middle, r: radius }));
  const reach = Math.max(0.02, ...state.vars.map(([mean]) => mean === null ? 0 : Math.abs(mean - 1)));
  ring.place.vars.forEach((spot, i) => {
    const [mean] = state.vars[i];
    if (mean === null) return;
    for (const s of spot.s) {
      const [x1, y1] = at(s, radius), [x2, y2] = at(s, radius * (1 + 0.2 * (mean - 1) / reach));
      const bar = node("line", { class: kind(state.vars[i]), x1, y1, x2, y2, "stroke-width": 4 });
      bar.append(node("title", {}, `${spot.name}: ${mean.toFixed(4)} ± ${state.vars[i][1].toFixed(4)}`));
      svg.append(bar);
    }
  });
  // outside of its mark, on either side
  const label = (spot, s, r) => {
    const [x, y] = at(s, r), aside = (x - middle) / r * Math.sign(r - radius);
    const anchor = Math.abs(aside) < 0.4 ? "middle" : aside > 0 ? "start" : "end";
    svg.append(node("text", { x, y: y + 4, "text-anchor": anchor, class: "pale" }, spot.name));
  };
  ring.place.monitors.forEach((spot, i) => {
    const well = state.monitors[i].state === "ok", s = spot.s[0], [cx, cy] = at(s, radius * (spot.name.startsWith("y") ? 1.27 : 1.22));
    const dot = node("circle", { class: well ? "usual hollow" : "faulty", cx, cy, r: well ? 2.5 : 5 });
    dot.append(node("title", {}, `${spot.name}: ${state.monitors[i].state}`));
    svg.append(dot);
    if (!well) label(spot, s, radius * 1.36);
  });
  ring.place.correctors.forEach((spot, i) => {
    const well = (state.correctors[i] ?? { state: "ok" }).state === "ok", s = spot.s[0], [x, y] = at(s, radius * 0.78), r = well ? 2.5 : 5;
    const mark = node("path", { class: well ? "usual hollow" : "faulty", d: `M${x} ${y - r}L${x + r} ${y + r}L${x - r} ${y + r}Z` });
    mark.append(node("title", {}, `${spot.name}: ${well ? "ok" : state.correctors[i].state}`));
    svg.append(mark);
    if (!well) label(spot, s, radius * 0.66);
  });
  const wrong = state.monitors.concat(state.correctors).filter((each) => each.state !== "ok").length;
  svg.append(node("text", { x: middle, y: middle - 4, "text-anchor": "middle" }, `${ring.place.circumference.toFixed(1)} m`));
  svg.append(node("text", { x: middle, y: middle + 14, "text-anchor": "middle", class: "pale" }, wrong ? `${wrong} not ok` : "all instruments ok"));
  put("ring", svg);
}

function residuals(state) {
  const wide = width("residuals"), left = 40, right = 8, top = 8, high = 190, bottom = 44;
  const shown = state.monitors.flatMap((each) => [each.noise_mm == null ? 0 : 2 * each.noise_mm, each.use === "used" ? Math.abs(each.residual_mm ?? 0) : 0]);
  const reach = 1.1 * Math.max(0.01, ...shown), svg = picture(wide, top + high + bottom, "Readings less what the estimate expects");
  const y = (mm) => top + high / 2 * (1 - Math.max(-1, Math.min(1, mm / reach)));
  for (const tick of ticks(-reach, reach, 4)) {
    svg.append(node("line", { class: tick === 0 ? "nominal" : "axis", x1: left, x2: wide - right, y1: y(tick), y2: y(tick) }));
    svg.append(node("text", { class: "pale", x: left - 5, y: y(tick) + 4, "text-anchor": "end" }, tick));
  }
  svg.append(node("text", { class: "pale", x: 2, y: top + 4 }, "mm"));
  const step = (wide - left - right) / state.monitors.length;
  state.monitors.forEach((each, i) => {
    const x = left + (i + 0.5) * step, name = ring.place.monitors[i].name;
    const group = node("g");
    group.append(node("title", {}, `${name}: ${each.residual_mm == null ? each.use : `${each.residual_mm.toFixed(3)} mm, ${each.use}`}, noise ${each.noise_mm?.toFixed(3)} mm, ${each.state}`));
    if (each.noise_mm != null) group.append(node("rect", { class: "band", x: x - step / 2, width: step, y: y(2 * each.noise_mm), height: y(-2 * each.noise_mm) - y(2 * each.noise_mm) }));
    if (each.residual_mm != null) {
      const [from, to] = [Math.min(y(0), y(each.residual_mm)), Math.max(y(0), y(each.residual_mm))];
      const look = each.state === "ok" ? "usual" : "faulty";
      group.append(node("rect", { class: each.use === "used" ? look : `${look} hollow`, x: x - 0.3 * step, width: 0.6 * step, y: from, height: Math.max(1, to - from) }));
    }
    group.append(node("text", { transform: `translate(${x + 4} ${top + high + 6}) rotate(-90)`, "text-anchor": "end", class: `${each.state === "ok" ? "pale" : "faulty"}${step < 11 ? " small" : ""}` }, name));
    svg.append(group);
  });
  put("residuals", svg);
}

const percent = (share) => `${Math.round(100 * share)} %`;
function unwell(state) {
  const seen = {
    noisy: (r) => `scatters ${r[0].toFixed(1)} times as much as expected`,
    jumps: (r) => `${percent(r[1])} of its frames are far off`,
    dead: (r) => `missing, stuck or without effect in ${percent(r[2])} of its frames`,
    back: () => "its fault has ended a short while ago",
  };
  const all = [...state.monitors.map((each, i) => [ring.place.monitors[i].name, each]), ...state.correctors.map((each, i) => [ring.place.correctors[i].name, each])];
  const rows = all.filter(([, each]) => each.state !== "ok").map(([name, each]) => [name, each.state, each.ratios ? seen[each.state](each.ratios) : ""]);
  $("healthy").textContent = `${state.monitors.filter((each) => each.state === "ok").length} of ${state.monitors.length} monitors and ${state.correctors.filter((each) => each.state === "ok").length} of ${state.correctors.length} correctors are ok.`;
  $("unwell").hidden = rows.length === 0;
  table("unwell", rows);
}

function table(id, rows, bad = () => false) {
  $(id).tBodies[0].replaceChildren(...rows.map((cells) => {
    const row = document.createElement("tr");
    row.className = bad(cells) ? "bad" : "";
    row.append(...cells.map((text, i) => {
      const cell = document.createElement("td");
      [cell.textContent, cell.className] = [text, i > 0 && typeof text === "number" ? "number" : ""];
      return cell;
    }));
    return row;
  }));
}

function faults(state) {
  const f = state.faults;
  const rows = [["frames dropped from a full buffer", f.dropped], ["packets damaged", f.damaged], ["frames refused by the core", f.refused], ["frames put aside: without beam, or with one that the model does not know", state.put_aside ?? 0], ["connections lost", f.disconnected], ["checkpoints not saved", f.unsaved], ["rows of the history not written", state.history_rows_lost]];
  table("faults", rows, ([, number]) => number > 0);
}

async function trail() {
  const over = $("span").value, wide = width("trail"), left = 50, right = 10, top = 24, high = 180, bottom = 24;
  const reply = await fetch(`/trail.json?span=${over}&var=${encodeURIComponent(chosen)}`);
  const points = (await reply.json()).points.filter(([, mean]) => mean !== null);
  const svg = picture(wide, top + high + bottom, `History of ${chosen}`);
  const long = { hour: 36e5, day: 864e5, month: 2592e6 }[over], now = Date.now();
  const first = points.length ? Math.min(points[0][0], now - long / 60) : now - long, from = Math.max(now - long, first);
  const low = Math.min(1, ...points.map(([, mean, sigma]) => mean - 2 * sigma)), top_ = Math.max(1, ...points.map(([, mean, sigma]) => mean + 2 * sigma));
  const pad = 0.05 * (top_ - low) || 0.01, x = (time) => left + (wide - left - right) * (time - from) / (now - from), y = (value) => top + high * (top_ + pad - value) / (top_ - low + 2 * pad);
  for (const tick of ticks(low - pad, top_ + pad, 4)) {
    svg.append(node("line", { class: tick === 1 ? "nominal" : "axis", x1: left, x2: wide - right, y1: y(tick), y2: y(tick) }));
    svg.append(node("text", { class: "pale", x: left - 5, y: y(tick) + 4, "text-anchor": "end" }, tick));
  }
  const clock = new Intl.DateTimeFormat("en-GB", over === "month" ? { day: "numeric", month: "short" } : { hour: "2-digit", minute: "2-digit" });
  for (let i = 0; i <= 4; i++) {
    const time = from + (now - from) * i / 4;
    svg.append(node("text", { class: "pale", x: x(time), y: top + high + 16, "text-anchor": i === 0 ? "start" : i === 4 ? "end" : "middle" }, clock.format(time)));
  }
  const line = (value) => points.map((point, i) => `${i ? "L" : "M"}${x(point[0]).toFixed(1)} ${y(value(point)).toFixed(1)}`).join("");
  if (points.length) {
    const back = [...points].reverse().map((point) => `L${x(point[0]).toFixed(1)} ${y(point[1] - 2 * point[2]).toFixed(1)}`).join("");
    svg.append(node("path", { class: "area", d: `${line((point) => point[1] + 2 * point[2])}${back}Z` }), node("path", { class: "curve", d: line((point) => point[1]) }));
    points.filter((point) => point[4]).forEach((point) => svg.append(node("line", { class: "faulty", x1: x(point[0]), x2: x(point[0]), y1: top + high - 6, y2: top + high })));
    const [, mean, sigma] = points[points.length - 1];
    svg.append(node("circle", { class: "weak", cx: x(points[points.length - 1][0]), cy: y(mean), r: 3 }));
    svg.append(node("text", { x: left, y: 12 }, `${chosen}: ${mean.toFixed(4)} ± ${sigma.toFixed(4)}; the band is two error bars`));
  } else svg.append(node("text", { x: left, y: 12, class: "pale" }, "no estimates in this time"));
  put("trail", svg);
}

async function look() {
  try {
    if (!ring) {
      ring = await (await fetch("/ring.json")).json();
      $("machine").textContent = document.title = ring.place.machine;
      $("publisher").textContent = `published by ${ring.publisher}`;
      chosen = ring.place.vars[0]?.name;
      $("var").replaceChildren(...ring.place.vars.map((spot) => new Option(spot.name)));
    }
    last = await (await fetch("/state.json")).json();
    failed = 0;
  } catch {
    failed += 1;
  }
  if (last) {
    verdict(last);
    numbers(last);
    faults(last);
    if (last.vars) [vars, map, residuals, unwell].forEach((draw) => draw(last));
  } else if (failed) verdict({});
}

$("var").addEventListener("change", () => { chosen = $("var").value; if (last?.vars) vars(last); trail(); });
$("span").addEventListener("change", trail);
addEventListener("resize", () => { if (last?.vars) look().then(trail); });
look().then(trail);
setInterval(look, 1000);
setInterval(() => trail().catch(() => {}), 10_000);
