"use strict";
const $ = (id) => document.getElementById(id);
const CHOICES = ["motor", "kind", "rule"];
const SLIDERS = ["severity_percent", "noise_ma", "resistance_percent", "friction_percent", "false_alarm_percent"];
const NAMES = { healthy: "healthy", bearing: "bearing: friction up", winding_contact: "winding: resistance up",
  winding_short: "winding: shorted turns", noise: "sensor noise: variance up", magnet: "magnet: less flux",
  current_dead: "current sensor: dead", current_gain: "current sensor: wrong scale", current_offset: "current sensor: offset",
  current_drift: "current sensor: drift",
  current_polarity: "current sensor: reversed", current_stuck: "current sensor: stuck", current_clipped: "current sensor: clipped" };
let seed = 1, round = 0, timer = 0, largest = 0;

function node(tag, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

function ticks(low, high, about) {
  const raw = Math.max(high - low, 1e-12) / about, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999), out = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= high / step + 1e-9; k += 1) out.push(k * step);
  return out;
}

// One picture: curves over time, an optional horizontal limit, band and alarm.
function draw(svg, time, curves, extra = {}) {
  const width = svg.clientWidth || 800, height = svg.clientHeight || 185, left = 58, right = width < 520 ? 28 : 86, top = 10, bottom = 26;
  const levels = [...(extra.limit === undefined ? [] : [extra.limit]), ...(extra.band ? [extra.band, -extra.band] : []), 0];
  let low = Math.min(...levels), high = Math.max(...levels);
  for (const curve of curves) for (const y of curve.values) { if (y < low) low = y; if (y > high) high = y; }
  const room = 0.06 * (high - low || 1); low -= room; high += room;
  const t0 = time[0], t1 = time[time.length - 1];
  const X = (t) => left + (t - t0) / (t1 - t0) * (width - left - right);
  const Y = (y) => height - bottom - (y - low) / (high - low) * (height - top - bottom);
  const parts = [], beside = width < 520 ? { x: width - right - 4, "text-anchor": "end" } : { x: width - right + 8 };
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  if (extra.band) parts.push(node("rect", { class: "band", x: left, width: width - left - right, y: Y(extra.band), height: Y(-extra.band) - Y(extra.band) }));
  for (const y of ticks(low, high, 4)) {
    parts.push(node("line", { class: "grid", x1: left, x2: width - right, y1: Y(y), y2: Y(y) }));
    parts.push(node("text", { x: left - 7, y: Y(y) + 4, "text-anchor": "end" }, +y.toPrecision(3) + (extra.unit || "")));
  }
  for (const t of ticks(t0, t1, Math.max(2, Math.min(8, Math.floor((width - left - right) / 80))))) {
    parts.push(node("text", { x: X(t), y: height - 8, "text-anchor": "middle" }, `${+t.toPrecision(4)}${extra.across || " ms"}`));
  }
  for (const curve of curves) {
    const d = curve.values.map((y, k) => `${k ? "L" : "M"}${X(time[k]).toFixed(1)} ${Y(y).toFixed(1)}`).join("");
    parts.push(node("path", { class: curve.name, d }));
    if (curve.label) parts.push(node("text", { class: `name t-${curve.name}`, ...beside, y: curve.at ?? Y(curve.values[curve.values.length - 1]) + 4 }, curve.label));
  }
  if (extra.limit !== undefined) {
    parts.push(node("line", { class: "limit", x1: left, x2: width - right, y1: Y(extra.limit), y2: Y(extra.limit) }));
    parts.push(node("text", { class: "name t-limit", ...beside, y: Y(extra.limit) + (width < 520 ? -6 : 4) }, "threshold"));
  }
  if (extra.dot) parts.push(node("circle", { class: "dot", cx: X(extra.dot[0]), cy: Y(extra.dot[1]), r: 6 }));
  if (extra.alarm != null) parts.push(node("line", { class: "alarm", x1: X(extra.alarm), x2: X(extra.alarm), y1: top, y2: height - bottom }));
  svg.replaceChildren(...parts);
}

function settings() {
  const out = { seed };
  for (const id of CHOICES) out[id] = $(id).value;
  for (const id of SLIDERS) out[id] = Number($(id).value);
  return out;
}

async function ask(path, body) {
  const response = await fetch(path, { method: "POST", body });
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.error);
  return answer;
}

function say(id, text, tone) {
  $(id).textContent = text;
  if (tone !== undefined) $(id).className = `big ${tone}`;
}

const TONE = { healthy: "good", unusable: "unsure", no_reference: "unsure" };
const tone = (verdict) => TONE[verdict] || "bad";

function label() {
  for (const id of SLIDERS) {
    const input = $(id), value = Number(input.value);
    document.querySelector(`output[for=${id}]`).textContent = `${"signed" in input.dataset && value > 0 ? "+" : ""}${value} ${input.dataset.unit}`;
  }
  $("severity_percent").disabled = $("kind").value === "healthy";
}

async function show() {
  const mine = ++round;
  label();
  clearTimeout(timer);
  $("verdict-card").classList.add("waiting");
  try {
    const body = JSON.stringify(settings()), seen = await ask("/api/simulate", body);
    if (mine !== round) return;
    draw($("current"), seen.time_ms, [{ name: "measured", values: seen.measured_a, label: "measured", at: 30 }, { name: "expected", values: seen.expected_a, label: "healthy", at: 50 }], { unit: " A" });
    draw($("residual"), seen.time_ms, [{ name: "residual", values: seen.residual_a.map((r) => 1e3 * r) }], { band: 3e3 * seen.noise_a, unit: " mA" });
    draw($("averaged"), seen.time_ms, [{ name: "averaged", values: seen.averaged_a.map((r) => 1e3 * r) }], { band: 1e3 * seen.averaged_band_a, unit: " mA" });
    draw($("statistic"), seen.time_ms, [{ name: "statistic", values: seen.statistic }], { limit: seen.threshold, alarm: seen.alarm_ms });
    $("rule-name").textContent = seen.rule;
    $("statistic-name").textContent = `${seen.rule}; threshold for ${settings().false_alarm_percent} % false alarms a start of the nominal motor`;
    say("alarm", seen.alarm_ms === null ? "no alarm" : `alarm after ${seen.alarm_ms.toFixed(1)} ms`, seen.alarm_ms === null ? "good" : "bad");
    $("alarm-detail").textContent = `largest statistic ${Math.max(...seen.statistic).toPrecision(3)}, threshold ${seen.threshold.toPrecision(3)}`;
    document.body.dataset.shown = String(mine);
    timer = setTimeout(() => judge(mine, body), 250);
  } catch (error) {
    empty(["verdict", "verdict-detail", "alarm-detail", "statistic-name", "roc-name"], ["current", "residual", "averaged", "statistic", "roc"]);
    say("alarm", error.message, "unsure");
  }
}

// What was shown of other settings must not stand beside an error.
function empty(texts, pictures) {
  for (const id of texts) $(id).textContent = "";
  for (const id of pictures) $(id).replaceChildren();
}

async function judge(mine, body) {
  try {
    const told = await ask("/api/verdict", body);
    if (mine !== round) return;
    say("verdict", words(told), tone(told.verdict));
    const smallest = Object.entries(told.smallest_changes || {}).map(([kind, share]) => `${NAMES[kind] || kind} ${Math.round(100 * share)} %`);
    $("verdict-detail").textContent = sentences(told.reasons) + (smallest.length ? ` Smallest that it finds in 95 of 100: ${smallest.join(", ")}.` : "");
    $("verdict-card").classList.remove("waiting");
    document.body.dataset.judged = String(mine);
    const roc = await ask("/api/roc", body);
    if (mine !== round) return;
    draw($("roc"), roc.false_alarms.map((x) => 100 * x), [{ name: "roc", values: roc.found.map((y) => 100 * y) }], { unit: " %", across: " %", dot: roc.at.map((x) => 100 * x) });
    $("roc-name").textContent = `share of ${roc.starts} starts with this fault that ${$("rule").selectedOptions[0].text} finds; the dot is the slider's`;
    document.body.dataset.compared = String(mine);
  } catch (error) {
    empty(["verdict-detail", "roc-name"], ["roc"]);
    say("verdict", error.message, "unsure");
  }
}

function words(told) {
  const percent = (x) => `${Math.round(100 * x)} %`;
  const size = told.severity ? `, ${percent(told.severity)}` : "";
  const between = told.severity && told.severity_interval ? ` (${told.severity_interval.map(percent).join(" to ")})` : "";
  const sure = told.confidence ? `, ${told.confidence > 0.99 ? "over 99 %" : percent(told.confidence)} sure` : "";
  return `${told.verdict.replace("_", " ")}${size}${between}${sure}`;
}

function sentences(reasons) {
  return reasons.map((reason) => `${reason[0].toUpperCase()}${reason.slice(1)}.`).join(" ");
}

async function take(file) {
  const box = $("recording");
  box.hidden = false;
  $("recording-name").textContent = file.name;
  $("recording-reasons").textContent = "";
  $("recording-current").replaceChildren(); $("recording-residual").replaceChildren();
  say("recording-verdict", "reading …", "");
  box.scrollIntoView({ block: "nearest" });
  try {
    if (file.size > largest) throw new Error(`a recording may have ${largest / 1e6} MB, this one has ${(file.size / 1e6).toFixed(1)} MB`);
    const query = new URLSearchParams({ name: file.name, motor: $("reference").value, voltage: $("voltage").value });
    const told = await ask(`/api/diagnose?${query}`, file);
    say("recording-verdict", words(told), tone(told.verdict));
    $("recording-reasons").textContent = sentences(told.reasons);
    if (told.curves) {
      const c = told.curves;
      const beside = c.healthy_a ? { values: c.healthy_a, label: "healthy" } : { values: c.fitted_a, label: "fitted" };
      draw($("recording-current"), c.time_ms, [{ name: "measured", values: c.measured_a, label: "measured", at: 30 }, { name: "expected", at: 50, ...beside }], { unit: " A" });
      draw($("recording-residual"), c.time_ms, [{ name: "residual", values: (c.beyond_a || c.residual_a).map((r) => 1e3 * r) }], { unit: " mA" });
    }
  } catch (error) { say("recording-verdict", error.message, "unsure"); }
  box.scrollIntoView({ block: "nearest" });
  document.body.dataset.taken = file.name;
}

async function keep(kind, files) {
  try {
    for (const file of files) {
      const kept = await ask(`/api/keep?${new URLSearchParams({ kind, name: file.name })}`, file);
      if (![...$("reference").options].some((option) => option.value === kept.reference)) $("reference").add(new Option(kept.reference, kept.reference));
      $("reference").value = kept.reference;
      $("kept").textContent = kind === "motor" ? `compared with ${kept.name}` : `compared with ${kept.healthy} healthy starts`;
    }
  } catch (error) { $("kept").textContent = error.message; }
  document.body.dataset.kept = kind;
}

function fill(select, entries) {
  select.replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
}

async function begin() {
  const given = await (await fetch("/api/options")).json();
  largest = given.largest_upload_bytes;
  fill($("motor"), given.motors.map((m) => [m, m]));
  fill($("kind"), given.kinds.map((k) => [k, NAMES[k] || k]));
  fill($("rule"), given.rules.map((r) => [r.name, r.label]));
  fill($("reference"), [...given.motors.map((m) => [m, `motor ${m}`]), ["", "nothing"]]);
  for (const id of SLIDERS) [$(id).min, $(id).max] = given.ranges[id];
  for (const [id, value] of Object.entries(given.defaults)) if ($(id)) $(id).value = value;
  for (const id of CHOICES) $(id).addEventListener("change", show);
  for (const id of SLIDERS) $(id).addEventListener("input", show);
  $("again").addEventListener("click", () => { seed += 1; show(); });
  const drop = $("drop");
  drop.addEventListener("click", () => $("file").click());
  drop.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); $("file").click(); } });
  $("file").addEventListener("change", () => { if ($("file").files.length) take($("file").files[0]); $("file").value = ""; });
  for (const [id, kind] of [["own-motor", "motor"], ["healthy-starts", "healthy"]]) $(id).addEventListener("change", () => keep(kind, $(id).files));
  for (const kind of ["dragover", "drop"]) window.addEventListener(kind, (event) => event.preventDefault());
  drop.addEventListener("dragover", () => drop.classList.add("over"));
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => { drop.classList.remove("over"); if (event.dataTransfer.files.length) take(event.dataTransfer.files[0]); });
  window.addEventListener("resize", show);
  show();
}

begin();
