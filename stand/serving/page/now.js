// The first view: what the stand does now, and how it came to it.
import { get } from "./api.js";
import { Curves } from "./curves.js";
import { further, hidden, look_of, set_hidden, temperatures } from "./channels.js";
import { clock, day_clock, fill, h, number, say, seconds, unit_of } from "./dom.js";
import { FramePanel } from "./frame.js";

const RANGES = [["10 min", 600], ["1 h", 3600], ["4 h", 14400], ["12 h", 43200], ["24 h", 86400], ["7 days", 604800]];
const TREND_S = 300;
const CHOSEN = "thermostand.range";

export class Now {
  constructor(place, app) {
    this.app = app;
    this.hidden = hidden();
    this.span_s = Number(localStorage.getItem(CHOSEN)) || 3600;
    this.fixed = null; // [from_s, to_s] after a zoom
    this.trends = {};
    this.build(place);
    this.timer = setTimeout(() => this.refresh(), 0);
    this.trend_timer = setInterval(() => this.find_trends(), 15000);
    this.find_trends();
    this.on_colours = () => this.draw();
    this.colours = matchMedia("(prefers-color-scheme: dark)");
    this.colours.addEventListener("change", this.on_colours);
  }

  build(place) {
    const zoom = this.zoom = (from_s, to_s) => { this.fixed = [from_s, to_s]; this.soon(); };
    this.ranges = h("div", { class: "row", role: "group", "aria-label": "Time shown" },
      RANGES.map(([name, span_s]) => h("button", { type: "button", class: "small", "data-span": span_s, onclick: () => this.choose(span_s) }, name)),
      this.back = h("button", { type: "button", class: "small", hidden: true, onclick: () => this.choose(this.span_s) }, "Back to now"));
    const above = h("div", { class: "curve", role: "img", "aria-label": "Temperatures over time; their values are in the table of readings" });
    const power = h("div", { class: "curve", role: "img", "aria-label": "Heater power over time, and when the compressor ran" });
    const drift = h("div", { class: "curve", role: "img", "aria-label": "Drift of the markers over time" });
    this.drift_box = h("div", { hidden: true }, h("p", { class: "curve-name" }, "Drift since the reference, px"), drift);
    this.further_box = h("div", {});
    const narrow = innerWidth < 700;
    this.plots = {
      above: new Curves(above, { height: narrow ? 250 : 340, unit: "°C", labels: !narrow, axis: false, marks: true, on_zoom: zoom }),
      power: new Curves(power, { height: 112, unit: "%", range: [-26, 105], space: 36, labels: !narrow, lane: { channel: "relays.compressor", name: "compressor" }, on_zoom: zoom }),
      drift: new Curves(drift, { height: 130, unit: "px", labels: !narrow, marks: true, on_zoom: zoom }),
    };
    this.hint = h("small", { class: "hint" }, "drag across the curves to zoom");
    this.readings = h("tbody");
    this.flags = h("div", { class: "flags" });
    this.events = h("ul", {});
    this.frame_place = h("div", { class: "stack last" });
    fill(place, h("div", { class: "grid now" },
      h("div", { class: "stack side-panel" },
        h("section", { class: "panel" }, h("h2", {}, "Readings"),
          h("div", { class: "scroll" }, h("table", { class: "readings" },
            h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "press to hide a curve"), h("th", { scope: "col", class: "number" }, "now"), h("th", { scope: "col", class: "number" }, "per h"))),
            this.readings))),
        h("section", { class: "panel" }, h("h2", {}, "Stand"), this.flags),
        this.frame_place),
      h("div", { class: "stack" },
        h("section", { class: "panel" },
          h("div", { class: "head" }, h("h2", {}, "Temperatures"), this.hint, this.ranges),
          above, h("p", { class: "curve-name" }, "Heater power, and the compressor"), power, this.drift_box, this.further_box),
        h("section", { class: "panel" }, h("h2", {}, "What happened"), h("div", { class: "events", tabindex: "0", role: "region", "aria-label": "Events" }, this.events)))));
    this.frame = new FramePanel(this.frame_place, this.app, false);
    this.show_choice();
  }

  choose(span_s) {
    this.span_s = span_s;
    this.fixed = null;
    try { localStorage.setItem(CHOSEN, span_s); } catch { /* private windows keep nothing */ }
    this.soon();
  }

  soon() { clearTimeout(this.timer); this.show_choice(); this.refresh(); this.frame.soon(); }

  show_choice() {
    this.back.hidden = this.fixed === null;
    for (const button of this.ranges.querySelectorAll("[data-span]")) {
      button.setAttribute("aria-pressed", String(this.fixed === null && Number(button.dataset.span) === this.span_s));
    }
  }

  window_s() {
    if (this.fixed) return this.fixed;
    const now_s = this.app.now_s();
    return [now_s - this.span_s, now_s];
  }

  async refresh() {
    clearTimeout(this.timer);
    let next_ms = 2000;
    try {
      if (this.app.state && !document.hidden && !this.closed) next_ms = await this.fetch();
    } catch { /* the header says that the stand cannot be reached */ }
    if (!this.closed) this.timer = setTimeout(() => this.refresh(), next_ms);
  }

  async fetch() {
    const state = this.app.state, offset_s = state.utc_offset_ns / 1e9;
    const [from_s, to_s] = this.window_s();
    const shown = [...this.measured(), "regulator.mv_heat", "regulator.mv_cool", "regulator.running", "relays.compressor", ...this.app.cameras().flatMap((name) => [`${name}.drift_mean`, `${name}.drift_worst`])];
    const points = Math.max(200, Math.min(1600, Math.round(this.plots.above.place.clientWidth)));
    const at = (s) => Math.max(0, Math.round((s - offset_s) * 1e9));
    const path = `/history?from_ns=${at(from_s)}&to_ns=${at(to_s)}&points=${points}&channels=${encodeURIComponent(shown.join())}`;
    const history = await get(path);
    if (this.closed) return 1000;
    this.history = in_force(history);
    this.offset_s = offset_s;
    this.drawn = [from_s, to_s];
    this.draw();
    this.show_events(history.marks);
    if (this.fixed) return 3600e3;
    return Math.max(1000, Math.min(30000, history.width_ns / 1e6));
  }

  draw() {
    if (!this.history) return;
    const { history, offset_s } = this, [from_s, to_s] = this.drawn;
    const channels = temperatures(history.units);
    this.plots.above.show(history, channels, this.hidden, from_s, to_s, offset_s);
    this.plots.power.show(history, ["regulator.mv_heat", "regulator.mv_cool"], this.hidden, from_s, to_s, offset_s);
    const drift = Object.keys(history.low).filter((name) => name.includes(".drift_"));
    this.drift_box.hidden = !drift.length;
    if (drift.length) this.plots.drift.show(history, drift, this.hidden, from_s, to_s, offset_s);
    for (const [unit, channels] of Object.entries(this.further(history.units))) {
      this.further_plot(unit).show(history, channels, this.hidden, from_s, to_s, offset_s);
    }
  }

  // The curves of what is measured in a unit of its own.
  further_plot(unit) {
    const key = `in ${unit}`;
    if (!this.plots[key]) {
      const place = h("div", { class: "curve", role: "img", "aria-label": `What is measured in ${unit || "no unit"}, over time` });
      this.further_box.append(h("p", { class: "curve-name" }, unit ? `Measured in ${unit}` : "Measured, without a unit"), place);
      this.plots[key] = new Curves(place, { height: 130, unit, labels: innerWidth >= 700, marks: true, on_zoom: this.zoom });
    }
    return this.plots[key];
  }

  further(units) { return further(units, Object.keys(this.app.state.axes)); }

  // All that has a curve and a row: temperatures first.
  measured() {
    const units = this.units();
    return [...temperatures(units), ...Object.values(this.further(units)).flat()];
  }

  // K/h over the last five minutes, from the means of their first and last minute.
  async find_trends() {
    const state = this.app.state;
    if (!state || document.hidden) { if (!this.closed && !state) setTimeout(() => this.find_trends(), 1500); return; }
    const to_ns = state.now_ns, from_ns = to_ns - TREND_S * 1e9;
    try {
      const found = await get(`/history?from_ns=${from_ns}&to_ns=${to_ns}&points=300&channels=${encodeURIComponent(temperatures(this.units()).join())}`);
      for (const [channel, values] of Object.entries(found.low)) this.trends[channel] = slope(values, found.width_ns / 1e9);
    } catch { this.trends = {}; }
  }

  units() { return Object.fromEntries(Object.entries(this.app.state.readings).map(([name, { unit }]) => [name, unit])); }

  update(state) {
    const channels = this.measured();
    if (this.rows_of !== channels.join()) {
      this.rows_of = channels.join();
      this.rows = Object.fromEntries(channels.map((channel) => [channel, this.row(channel)]));
      fill(this.readings, Object.values(this.rows).map((row) => row.row));
    }
    for (const channel of channels) this.update_row(this.rows[channel], channel, state.readings[channel]);
    this.update_flags(state);
  }

  row(channel) {
    const look = look_of(channel);
    const button = h("button", { type: "button", onclick: () => this.toggle(channel) }, swatch(look), look.name);
    const value = h("td", { class: "number value" }), trend = h("td", { class: "number" });
    return { row: h("tr", {}, h("td", {}, button), value, trend), button, value, trend };
  }

  toggle(channel) {
    this.hidden.has(channel) ? this.hidden.delete(channel) : this.hidden.add(channel);
    set_hidden(this.hidden);
    this.update(this.app.state);
    this.draw();
  }

  update_row({ row, button, value, trend }, channel, reading) {
    const is_off = this.hidden.has(channel);
    button.setAttribute("aria-pressed", String(!is_off));
    is_off ? row.setAttribute("data-off", "") : row.removeAttribute("data-off");
    row.dataset.quality = reading.quality;
    row.title = reading.reason;
    const state = this.app.state, bad = { bad: "no reading", stale: "old" }[reading.quality];
    const unasked = channel === "regulator.sp" && state.setpoint_degC === null && reading.value !== null ? "none"
      : reading.value === null && !state.camera_on && this.app.cameras().includes(channel.split(".")[0]) ? "off" : "";
    if (unasked) row.dataset.quality = "good"; // nobody expects one now
    say(value, unasked || (reading.value === null ? bad ?? "–" : `${number(reading.value, 2)} ${unit_of(reading.unit)}${bad ? ` (${bad})` : ""}`));
    say(trend, channel === "regulator.sp" || reading.unit !== "degC" || unasked || reading.quality !== "good" ? "" : arrow(this.trends[channel]));
  }

  update_flags(state) {
    const flags = [
      ["Heater", state.heater_permitted ? "permitted" : "locked", state.heater_permitted],
      ["Output", output(state.output_percent), false],
      ["Compressor", state.compressor_on ? "running" : "off", state.compressor_on],
      ["Camera", state.camera_on ? "on" : "off", false],
      ["Flap", state.flap || "unknown", state.flap === "open"],
      ...Object.entries(state.axes).map(([name, position]) => [name, position === null ? "unknown" : `${number(position, 2)} ${unit_of(state.readings[`${name}.position`]?.unit ?? "")}`, false]),
      ["Frames saved", state.run ? String(state.run.frames_saved) : "–", false],
      ["Frames lost", state.run ? String(state.run.frames_lost) : "–", Boolean(state.run?.frames_lost)],
      ["Disk free", `${number(state.disk_free_bytes / 1e9, 0)} GB`, state.disk_free_bytes < 20e9],
    ];
    const key = flags.map((flag) => flag[0]).join();
    if (this.flag_names !== key) {
      this.flag_names = key;
      fill(this.flags, flags.map(([name]) => h("div", { class: "flag" }, h("small", {}, name), h("b", {}, ""))));
    }
    flags.forEach(([, text, is_on], index) => {
      const flag = this.flags.children[index];
      flag.dataset.on = is_on ? "yes" : "no";
      say(flag.lastChild, text);
    });
  }

  show_events(marks) {
    const listed = marks.filter((mark) => !["step", "reference"].includes(mark.level)).slice(-100).reverse();
    const key = listed.map((mark) => mark.time_ns).join();
    if (key === this.listed) return;
    this.listed = key;
    const glyph = { error: "▲", warning: "◆" };
    fill(this.events, listed.length ? listed.map((mark) => h("li", { class: `level-${mark.level}` },
      h("span", { class: "number" }, day_clock(seconds(mark.time_ns) + this.offset_s)), h("span", { "aria-label": mark.level }, glyph[mark.level] ?? "·"), h("span", {}, mark.text)))
      : h("li", {}, h("span"), h("span"), h("span", { class: "quiet" }, "nothing in the time shown")));
  }

  event() { this.frame.soon(); }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    clearInterval(this.trend_timer);
    this.colours.removeEventListener("change", this.on_colours);
    this.frame.close();
    for (const plot of Object.values(this.plots)) plot.destroy();
  }
}

// A set-point while the regulator is stopped is only what it remembers: no curve, and no part of the scale.
function in_force(history) {
  const { "regulator.running": runs, ...others } = history.low, set = others["regulator.sp"];
  if (!runs || !set) return { ...history, low: others };
  const only = (values) => values.map((value, n) => (runs[n] === 0 ? null : value));
  const more = history.high["regulator.sp"] ? { "regulator.sp": only(history.high["regulator.sp"]) } : {};
  return { ...history, low: { ...others, "regulator.sp": only(set) }, high: { ...history.high, ...more } };
}

function output(percent) {
  if (percent === null) return "–";
  const size = `${number(Math.abs(percent), 0)}\u00a0%`;
  return percent > 0 ? `heats, ${size}` : percent < 0 ? `cools, ${size}` : size;
}

function slope(values, width_s) {
  const mean = (part) => { const good = part.filter((value) => value !== null); return good.length ? good.reduce((a, b) => a + b, 0) / good.length : null; };
  const minute = Math.max(1, Math.round(60 / width_s));
  if (values.length < 2 * minute) return null;
  const first = mean(values.slice(0, minute)), last = mean(values.slice(-minute));
  return first === null || last === null ? null : ((last - first) / ((values.length - minute) * width_s)) * 3600;
}

function arrow(K_per_h) {
  if (K_per_h === null || K_per_h === undefined) return "";
  const size = Math.abs(K_per_h);
  if (size < 0.3) return "→ steady";
  return `${K_per_h > 0 ? (size < 6 ? "↗" : "↑") : size < 6 ? "↘" : "↓"} ${K_per_h > 0 ? "+" : "−"}${size.toFixed(size < 10 ? 1 : 0)} K`;
}

export function swatch(look) {
  const ns = "http://www.w3.org/2000/svg";
  const picture = document.createElementNS(ns, "svg"), line = document.createElementNS(ns, "line");
  picture.setAttribute("class", "swatch");
  picture.setAttribute("viewBox", "0 0 26 12");
  picture.setAttribute("aria-hidden", "true");
  for (const [name, value] of Object.entries({ x1: 0, y1: 6, x2: 26, y2: 6, "stroke-width": look.width + 1, "stroke-dasharray": look.dash.join(" ") })) line.setAttribute(name, value);
  line.style.stroke = `var(${look.colour})`;
  picture.append(line);
  return picture;
}
