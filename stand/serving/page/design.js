// What a recipe would do on this stand: its temperatures over time, frames, soaks, and what is wrong, drawn before it is queued.
import { send } from "./api.js";
import { bytes, clock, day_clock, duration, fill, h, number, say, seconds } from "./dom.js";

const WAIT_MS = 120; // after the last key; the stand answers in less
const HIGH = 240, LEFT = 60, BOTTOM = 26, TOP = 12;
const STEP_degC = 0.5; // a level is dragged by

const svg = (tag, attributes = {}, ...children) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null));
  return element;
};

const NAMES = { set: "set-point", air: "air, predicted", camera: "camera, predicted", soak: "soaks", capture: "frames", validation: "frames held out of the fit" };
const KEYS = {
  set: () => svg("path", { class: "set", d: "M0 5L24 5" }), air: () => svg("path", { class: "air", d: "M0 5L24 5" }), camera: () => svg("path", { class: "camera", d: "M0 5L24 5" }),
  soak: () => svg("rect", { class: "soak", x: 0, y: 3, width: 24, height: 4 }), capture: () => svg("circle", { class: "capture", cx: 12, cy: 5, r: 4 }), validation: () => svg("circle", { class: "capture validation", cx: 12, cy: 5, r: 4 }),
};

export class Design {
  // move(from, to): every set-point of `from` degC of the recipe becomes `to`. found(preview) is called with each answer.
  constructor(app, move, found) {
    Object.assign(this, { app, move, found, asked: 0 });
    this.chart = h("div", { class: "course" });
    this.legend = h("p", { class: "legend", "aria-hidden": "true" }, ["set", "air", "camera", "soak", "capture", "validation"].map((name) => [svg("svg", { viewBox: "0 0 24 10", class: "course" }, KEYS[name]()), h("span", {}, NAMES[name])]));
    this.facts = h("p", { class: "facts", role: "status" });
    this.begins = h("p", {});
    this.lacks = h("ul", { class: "lacks" });
    this.warnings = h("details", { hidden: true }, this.count = h("summary", {}), this.list = h("ul", { class: "warnings" }));
    this.quiet = h("p", { class: "quiet" });
    this.element = h("div", { class: "stack" }, this.chart, this.legend, this.facts, this.begins, this.lacks, this.warnings, this.quiet);
  }

  // request: what would be queued, or a function that gives it and may throw an Error with a sentence.
  soon(request, wait_ms = WAIT_MS) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask(request), wait_ms);
  }

  async ask(request) {
    const asked = ++this.asked;
    clearTimeout(this.timer);
    let answer;
    try { answer = await send("POST", "/previews", request()); } catch (error) {
      if (asked === this.asked) this.refuse(error.message);
      return;
    }
    if (asked !== this.asked || this.closed) return; // something was typed meanwhile
    this.preview = answer;
    this.show();
    this.found(answer);
  }

  refuse(text) {
    this.preview = null;
    this.found(null);
    fill(this.lacks, h("li", { class: "answer error" }, text));
    this.chart.classList.add("old");
    say(this.facts, "");
    say(this.begins, "");
  }

  show() {
    const { preview } = this, offset_ns = this.app.state?.utc_offset_ns ?? 0;
    this.chart.classList.remove("old");
    const end = preview.end_ns === null ? "" : ` · ends ${day_clock(seconds(preview.end_ns, offset_ns))}`;
    const back = preview.after_s ? ` and ${duration(preview.after_s)} back to the laboratory's temperature` : "";
    say(this.facts, `${duration(preview.duration_s)}${back} · ${preview.frames} frames · ${bytes(preview.size_bytes)} of ${bytes(preview.free_bytes)} free${end}`);
    say(this.begins, begins_text(preview, offset_ns));
    fill(this.lacks, preview.lacks.map((text) => h("li", { class: "answer error" }, text)));
    this.warnings.hidden = !preview.warnings.length;
    say(this.count, preview.warnings.length === 1 ? "1 warning" : `${preview.warnings.length} warnings`);
    fill(this.list, preview.warnings.map(({ step, at_s, text }) => h("li", {}, `step ${step + 1}, after ${duration(at_s)}: ${text}`)));
    say(this.quiet, [preview.looks, preview.learned].filter(Boolean).join(" · "));
    if (!this.dragged) fill(this.chart, course_svg(preview, this.chart.clientWidth, offset_ns, { drag: (from, to) => this.drag(from, to) }));
  }

  drag(from, to) { if (to !== from) this.move(from, to); }
  close() { this.closed = true; clearTimeout(this.timer); }
}

export function begins_text({ begins, ahead, begin_ns }, offset_ns) {
  const runs = ahead === 1 ? "1 run" : `${ahead} runs`;
  if (begins === "now") return "Added to the queue, it begins at once: the chamber heats or cools without another question.";
  if (begins === "halted") return `The queue is halted: it begins when somebody has reset the stand${ahead ? `, after ${runs}` : ""}.`;
  return begin_ns === null ? `It begins after ${runs}.` : `It begins after ${runs}, at about ${day_clock(seconds(begin_ns, offset_ns))}.`;
}

// The course of a plan. now_s: where now is, s after its beginning, or null; drag(from, to) is called when a level was moved.
export function course_svg(preview, width, offset_ns, { drag = null, now_s = null } = {}) {
  const WIDE = Math.max(320, width || 800);
  const { course, chamber_degC, dew_degC, begin_ns } = preview;
  const last_s = Math.max(1, course.times_s.at(-1) ?? 1);
  const known = [...course.set_point_degC, ...course.air_degC, ...course.camera_degC].filter((value) => value !== null);
  const low = Math.min(...known, dew_degC ?? Infinity, 20) - 3, high = Math.max(...known, 28) + 3;
  const x = (s) => LEFT + ((WIDE - LEFT - 8) * s) / last_s;
  const y = (degC) => TOP + ((HIGH - TOP - BOTTOM) * (high - degC)) / (high - low);
  const path = (values) => values.map((value, n) => (value === null ? "" : `${n && values[n - 1] !== null ? "L" : "M"}${x(course.times_s[n]).toFixed(1)} ${y(value).toFixed(1)}`)).join("");
  const band = (from, to, name) => (to > from ? svg("rect", { class: name, x: LEFT, width: WIDE - LEFT - 8, y: y(to), height: y(from) - y(to) }, svg("title", {}, name === "dew" ? `below ${number(dew_degC, 1)} °C the open flap would let dew form` : "outside the stand's limits")) : null);
  const levels = drag ? [...new Set(course.captures.map(({ chamber_degC: degC }) => degC).filter((degC) => degC !== null))] : [];
  return svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "group", "aria-label": preview.label ?? describe(preview) },
    band(Math.max(low, chamber_degC[1]), high, "limit"), band(low, Math.min(high, chamber_degC[0]), "limit"),
    dew_degC === null ? null : band(low, Math.min(high, dew_degC), "dew"),
    ticks_degC(low, high).map((degC) => [svg("line", { class: "grid-line", x1: LEFT, x2: WIDE - 8, y1: y(degC), y2: y(degC) }), svg("text", { x: LEFT - 12, y: y(degC) + 4, "text-anchor": "end" }, `${degC} °C`.replace("-", "−"))]),
    ticks_s(last_s, begin_ns, offset_ns, WIDE / 100).map(([s, text]) => svg("text", { x: x(s), y: HIGH - 8, "text-anchor": "middle" }, text)),
    course.soaks.map(({ from_s, to_s }) => svg("rect", { class: "soak", x: x(from_s), width: Math.max(1, x(to_s) - x(from_s)), y: HIGH - BOTTOM, height: 5 })),
    svg("path", { class: "camera", d: path(course.camera_degC) }), svg("path", { class: "air", d: path(course.air_degC) }), svg("path", { class: "set", d: path(course.set_point_degC) }),
    course.captures.filter(({ chamber_degC: degC }) => degC !== null).map((each) => svg("circle", { class: `capture ${each.role}`, cx: x(each.at_s + each.duration_s / 2), cy: y(each.chamber_degC), r: 5 }, svg("title", {}, `${number(each.chamber_degC, 1)} °C: ${each.frames} frames, ${each.role.replaceAll("_", " ")}, after ${duration(each.at_s)}`))),
    now_s === null ? null : svg("line", { class: "now", x1: x(now_s), x2: x(now_s), y1: TOP, y2: HIGH - BOTTOM }),
    levels.map((degC) => handle(degC, y(degC), (HIGH - TOP - BOTTOM) / (high - low), chamber_degC, drag)));
}

// A level of the set-point at the left edge: dragged, or moved with the arrow keys.
function handle(degC, at, per_K, limits, drag) {
  let from_y = null, moved = degC;
  const within = (value) => Math.min(limits[1], Math.max(limits[0], Math.round(value / STEP_degC) * STEP_degC));
  const element = svg("rect", { class: "handle", x: LEFT - 5, y: at - 6, width: 10, height: 12, rx: 3, tabindex: 0, role: "slider", "aria-orientation": "vertical", "aria-valuemin": limits[0], "aria-valuemax": limits[1], "aria-valuenow": degC, "aria-label": `set-point ${degC} °C`,
    onpointerdown: (event) => { from_y = event.clientY; element.setPointerCapture(event.pointerId); },
    onpointermove: (event) => {
      if (from_y === null) return;
      const scale = HIGH / element.ownerSVGElement.getBoundingClientRect().height;
      moved = within(degC - ((event.clientY - from_y) * scale) / per_K);
      element.setAttribute("y", at - (moved - degC) * per_K - 6);
      element.setAttribute("aria-valuenow", moved);
    },
    onpointerup: () => { from_y = null; drag(degC, moved); },
    onkeydown: (event) => {
      const by = { ArrowUp: STEP_degC, ArrowDown: -STEP_degC }[event.key];
      if (by) { event.preventDefault(); drag(degC, within(degC + by)); }
    } }, svg("title", {}, `drag, or press the arrow keys, to move every visit of ${degC} °C`));
  return element;
}

function describe({ course }) {
  const degC = course.set_point_degC.filter((value) => value !== null);
  if (!degC.length) return "Course of the plan: the chamber is not used";
  return `Course of the plan: ${course.captures.length} captures, set-points from ${Math.min(...degC)} to ${Math.max(...degC)} °C, ${duration(course.times_s.at(-1))}`;
}

function ticks_degC(low, high) {
  const step = high - low > 30 ? 10 : 5;
  return Array.from({ length: Math.floor(high / step) - Math.ceil(low / step) + 1 }, (_, n) => (Math.ceil(low / step) + n) * step);
}

// Full hours of the local time where it is known when the run begins, else hours from its beginning.
function ticks_s(last_s, begin_ns, offset_ns, most) {
  const step_s = [600, 1800, 3600, 7200, 14400, 28800, 86400].find((each) => last_s / each <= most) ?? 86400 * Math.ceil(last_s / 86400 / most);
  const begin_s = begin_ns === null ? 0 : seconds(begin_ns, offset_ns);
  const local_s = begin_ns === null ? 0 : begin_s - new Date(begin_s * 1000).getTimezoneOffset() * 60;
  const first_s = Math.ceil(local_s / step_s) * step_s - local_s;
  const found = [];
  for (let at_s = first_s; at_s <= last_s; at_s += step_s) found.push([at_s, begin_ns === null ? (step_s < 3600 ? duration(at_s) : `${at_s / 3600} h`) : clock(begin_s + at_s)]);
  return found;
}
