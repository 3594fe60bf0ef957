// The plan as a time line and as a list: what is done, how long soaks have lasted, what is to come and when.
import { called, commands, get, order, tell } from "./api.js";
import { course_svg } from "./design.js";
import { ask, axes_of, clock, day_clock, duration, fill, h, hold_resumes, number, say, seconds, words } from "./dom.js";
import { PlanEdit, step_schema } from "./plan_edit.js";

const SIGN = { done: "✓", under_way: "▶", waiting: "·", skipped: "⤼" };
const WORD = { done: "done", under_way: "under way", waiting: "to come", skipped: "left out" };
// Commands that have a place of their own.
const PLACED = new Set(["stop", "pause", "continue", "reset", "skip", "extend", "edit", "submit", "cancel", "move", "resume", "device", "note", "fault", "rehearse", "save_recipe", "remove_recipe"]);
const SETS = ["start_chamber", "set_temperature", "stop_chamber"]; // what begins a visit
const RESUMABLE = ["interrupted", "stopped", "failed"]; // a run that has tripped has failed here

export class Plan {
  constructor(place, app) {
    this.app = app;
    this.steps = [];
    this.opened = new Map(); // by a visit's first step, whether somebody has opened or folded it
    this.resumes = h("p", { class: "level-warning", role: "status" });
    this.answer = h("p", { class: "answer", role: "status" });
    this.buttons = h("div", { class: "row" },
      this.pause = called("pause", h("button", { type: "button", "data-order": "", onclick: () => this.order("pause", { when: "now" }, "pause") }), (title) => `${title} now`),
      this.pause_step = h("button", { type: "button", "data-order": "", onclick: () => this.pause_after() }, "Pause after this step"),
      this.go = called("continue", h("button", { type: "button", "data-order": "", class: "main", onclick: () => this.order("continue", undefined, "continue") })),
      this.edit_button = h("button", { type: "button", "data-order": "", onclick: () => this.edit() }, "Edit the steps to come …"),
      this.abort = h("button", { type: "button", class: "danger", onclick: () => this.end() }, "End the run …"));
    this.summary = h("p", {});
    this.line = h("div", { class: "course" });
    this.list = h("ol", { class: "steps" });
    this.asks = h("div", {});
    this.edits = h("div", {});
    this.more = h("div", { class: "row" });
    commands().then((known) => fill(this.more, [...known.values()].filter(({ name }) => !PLACED.has(name)).map((each) => this.form(each))), () => {});
    fill(place, h("div", { class: "stack" },
      h("section", { class: "panel" }, h("div", { class: "head" }, h("h2", {}, "Run"), this.buttons), this.more, this.summary, this.asks, this.answer, this.edits, this.line),
      h("section", { class: "panel" }, h("h2", {}, "Steps"), this.list)));
    this.refresh();
    this.timer = setInterval(() => this.refresh(), 5000);
  }

  async order(verb, body, text) {
    await order(this.answer, verb, body, text);
    this.refresh();
  }

  // A command that has no place of its own on this page: its button, and a field for each thing that it takes.
  form({ name, title, text, argument }) {
    const fields = Object.entries(argument.properties ?? {}).map(([field, { type, description }]) => {
      const is_number = type === "number" || type === "integer", kind = type === "boolean" ? "checkbox" : is_number ? "number" : "text";
      const input = h("input", { type: kind, step: is_number ? "any" : null, size: 8, title: description, required: argument.required?.includes(field) });
      const value = () => (kind === "checkbox" ? input.checked : is_number && input.value ? Number(input.value) : input.value);
      return { field, value, shown: h("label", {}, `${words(field)} `, input) };
    });
    const given = () => Object.fromEntries(fields.map(({ field, value }) => [field, value()]).filter(([, value]) => value !== "" && value !== false));
    return h("form", { class: "row", title: text, onsubmit: (event) => { event.preventDefault(); this.order(name, given(), title.toLowerCase()); } },
      fields.map(({ shown }) => shown), h("button", { type: "submit", "data-order": "" }, title));
  }

  pause_after() {
    if (this.app.state?.pausing) return this.order("continue", undefined, "take the pause back");
    return this.order("pause", { when: "step" }, "pause when this step is done");
  }

  end() {
    ask(this.asks, "End the run? The stand is made safe; what is recorded stays, and the run can be resumed later.", "End the run",
      () => this.order("stop", undefined, "end the run"));
  }

  async edit() {
    if (this.editor) return this.editor.head.focus();
    const first = this.steps.findIndex((step) => step.standing === "waiting" && this.steps.slice(step.index).every((later) => later.standing === "waiting"));
    if (first < 0) return tell(this.answer, "no step is to come that was not begun", true);
    let schema;
    try { schema = await step_schema(); } catch (error) { return tell(this.answer, error.message, true); }
    const over = () => { this.editor = null; this.edit_button.focus(); this.refresh(); };
    this.editor = new PlanEdit(this.edits, schema, axes_of(this.app.state), this.steps[first].index, this.steps.slice(first), this.answer, over);
  }

  async refresh() {
    if (document.hidden || this.closed || this.app.is_lost) return;
    try { this.steps = await get("/plan"); } catch { return; }
    if (!this.closed) this.show();
  }

  show() {
    const { steps } = this;
    this.editor?.update(steps);
    if (this.list.querySelector(".ask")) return; // a question is open
    const focused = document.activeElement?.dataset?.key;
    const visits = visits_of(steps), now = visits.findIndex(({ standing }) => standing === "under_way");
    const first = now < 0 ? visits.findIndex(({ standing }) => standing === "waiting") : now;
    fill(this.list, visits.map((visit, index) => this.visit(visit, index === first || index === first + 1)));
    if (focused) this.list.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
    if (!steps.length) fill(this.list, this.last_run());
    this.draw();
    this.update(this.app.state);
  }

  // A set-point and what is done at it; its steps are made when it is open.
  visit(visit, is_next) {
    const key = visit.steps[0].step_id, last = visit.steps.at(-1), rows = h("ol", { class: "steps" });
    const part = h("details", {}, h("summary", { "data-key": key }, h("span", { "aria-hidden": "true" }, SIGN[visit.standing]), h("span", { class: "unseen" }, WORD[visit.standing]),
      h("b", {}, ` ${visit.title}`), h("span", { class: "quiet" }, ` ${this.when(last)}`)), rows);
    const show = () => { if (part.open && !rows.children.length) fill(rows, visit.steps.map((step) => this.row(step))); };
    part.open = this.opened.get(key) ?? is_next;
    show();
    part.addEventListener("toggle", () => { if (part.open !== (this.opened.get(key) ?? is_next)) this.opened.set(key, part.open); show(); });
    return h("li", { class: "visit", "data-visit": visit.standing }, part);
  }

  // Nothing is run: the last run, if it can be resumed, or what to do first.
  last_run() {
    const run = this.app.state?.queue.filter(({ state, session }) => RESUMABLE.includes(state) && session).at(-1);
    if (!run) return h("li", { class: "quiet" }, "No run. ", h("a", { href: "#queue" }, "Design one and add it to the queue."));
    const resume = called("resume", h("button", { type: "button", class: "main", "data-order": "", "data-resume": true, onclick: () => this.order("resume", { session: run.session }) }));
    return h("li", { class: "stack" }, h("p", {}, h("b", {}, `${run.recipe} (run ${run.id}) was ${run.state}`), run.reason ? `: ${run.reason}` : ""),
      h("p", {}, "Resumed, it goes on in its session. What is done is not done again, and frames that are recorded count. A warm-up that was broken off begins again with a cold camera."), h("div", { class: "row" }, resume), this.resumes);
  }

  row(step) {
    const is_open = step.standing === "waiting" || step.standing === "under_way";
    const acts = h("span", { class: "acts" });
    const button = (name, act, text) => acts.append(called(name, h("button", { type: "button", class: "small", "data-order": "", "data-key": `${step.step_id} ${name}`, onclick: act }), text, (title) => `${text ? text(title) : title}: step ${step.index + 1}`));
    const row = h("li", { "data-standing": step.standing },
      h("span", { title: WORD[step.standing] }, h("span", { "aria-hidden": "true" }, SIGN[step.standing]), h("span", { class: "unseen" }, WORD[step.standing])),
      h("span", { class: "index number quiet" }, String(step.index + 1)),
      h("span", {}, step.text || step.kind, progress_text(step)),
      h("span", { class: "bar" }, step.standing === "under_way" ? bar(step) : null),
      h("span", { class: "number quiet" }, this.when(step)), acts);
    if (is_open && step.kind.startsWith("soak")) {
      button("extend", () => this.order("extend", { step_id: step.step_id, by_s: 900 }, "extend by 15 min"), () => "+15 min");
    }
    if (is_open) button("skip", () => ask(row, `Leave out step ${step.index + 1}, ${step.text || step.kind}?`, "Leave it out", () => this.order("skip", { step_id: step.step_id }, "skip")));
    return row;
  }

  when(step) {
    const offset_ns = this.app.state?.utc_offset_ns ?? 0;
    if (step.ended_ns) return `${step.standing === "skipped" ? "left out" : "done"} ${clock(seconds(step.ended_ns, offset_ns))}`;
    if (step.standing === "done" || step.standing === "skipped") return WORD[step.standing];
    const takes = step.duration_s >= 1 ? duration(step.duration_s) : "";
    return step.expected_ns ? `${takes ? `${takes}, until ` : "at "}${day_clock(seconds(step.expected_ns, offset_ns))}` : takes;
  }

  update(state) {
    if (!state) return;
    const is_run = state.run !== null, is_held = state.reasons.length > 0;
    this.pause.disabled = this.pause_step.disabled = !is_run || state.reasons.includes("operator");
    say(this.pause_step, is_run && state.pausing ? "Do not pause after this step" : "Pause after this step");
    this.go.disabled = !is_run || !state.reasons.includes("operator");
    this.abort.disabled = !is_run;
    this.edit_button.disabled = !is_run || !this.steps.length;
    hold_resumes(this.list, this.resumes, state);
    if (!is_run) return say(this.summary, "No run is under way.");
    const run = state.run;
    const end = run.end_ns === null ? "" : `; ends ${day_clock(seconds(run.end_ns, run.utc_offset_ns))}${uncertainty(run)}`;
    say(this.summary, `${run.recipe}, session ${run.run_id || "–"}: step ${run.step} of ${run.steps}${is_held ? `, held: ${state.prompt ? "it waits for you" : state.reasons.map(this.app.reason).join(", ")}` : state.pausing ? ", pauses when it is done" : ""}${end}`);
  }

  // The set-point over time, with now on it.
  draw() {
    const { steps, app: { state } } = this, { now_s, ...course } = course_of(steps, state);
    const count = steps.filter((step) => step.standing === "done").length;
    const begin_ns = state && now_s !== null ? state.now_ns - now_s * 1e9 : null;
    const preview = { course, chamber_degC: [-Infinity, Infinity], dew_degC: null, begin_ns, label: `Time line of the plan: ${count} of ${steps.length} steps are done` };
    fill(this.line, steps.length ? course_svg(preview, this.line.clientWidth, state?.utc_offset_ns ?? 0, { now_s }) : null);
  }

  soon() { this.refresh(); }
  event(event) { if (event.kind === "step" || event.kind === "plan_changed") { clearTimeout(this.later); this.later = setTimeout(() => this.refresh(), 200); } }
  close() { this.closed = true; this.editor?.close(); clearInterval(this.timer); clearTimeout(this.later); }
}

// Steps from one change of the set-point to the next.
function visits_of(steps) {
  const found = [];
  for (const step of steps) {
    if (!found.length || SETS.includes(step.kind)) found.push({ steps: [] });
    found.at(-1).steps.push(step);
  }
  return found.map((visit) => ({ ...visit, title: title_of(visit.steps), standing: standing_of(visit.steps) }));
}

// As in `31 °C: soak 45 min, 2 frames (fit)`.
function title_of(steps) {
  const soaked_s = steps.filter(({ kind }) => kind.startsWith("soak")).reduce((sum, step) => sum + step.duration_s, 0);
  const frames = new Map();
  for (const { kind, parameters, frames: count } of steps) if (kind === "capture") frames.set(parameters.role, (frames.get(parameters.role) ?? 0) + count);
  const parts = [soaked_s ? `soak ${duration(soaked_s)}` : "", ...[...frames].map(([role, count]) => `${count} ${count === 1 ? "frame" : "frames"} (${words(role ?? "other")})`)].filter(Boolean);
  const [{ kind, parameters }] = steps, place = !SETS.includes(kind) ? "before the first set-point" : kind === "stop_chamber" ? "chamber stopped" : `${number(parameters.chamber_degC, 1).replace(/\.0$/, "")} °C`;
  return parts.length ? `${place}: ${parts.join(", ")}` : `${place}: ${steps.length === 1 ? "1 step" : `${steps.length} steps`}`;
}

function standing_of(steps) {
  if (steps.some(({ standing }) => standing === "under_way")) return "under_way";
  if (steps.every(({ standing }) => standing === "waiting")) return "waiting";
  return steps.some(({ standing }) => standing === "waiting") ? "under_way" : "done";
}

// Set-points over the time that steps have taken, or are expected to, and where now is, s; null without a run.
function course_of(steps, state) {
  const course = { times_s: [], set_point_degC: [], air_degC: [], camera_degC: [], captures: [], soaks: [], now_s: null };
  let at_s = 0, degC = null;
  for (const step of steps) {
    const lasts_s = step.ended_ns && step.began_ns ? (step.ended_ns - step.began_ns) / 1e9 : step.standing === "skipped" ? 0 : step.duration_s;
    if (SETS.includes(step.kind)) degC = step.parameters.chamber_degC ?? null;
    for (const time_s of [at_s, at_s + lasts_s]) { course.times_s.push(time_s); course.set_point_degC.push(degC); }
    if (step.kind === "capture") course.captures.push({ step: step.index, at_s, duration_s: lasts_s, chamber_degC: degC, role: step.parameters.role ?? "other", frames: step.frames });
    if (step.kind.startsWith("soak")) course.soaks.push({ step: step.index, from_s: at_s, to_s: at_s + lasts_s });
    if (step.standing === "under_way") course.now_s = at_s + (step.began_ns && state ? Math.min(lasts_s, (state.now_ns - step.began_ns) / 1e9) : soaked_share(step) * lasts_s);
    else if (step.standing === "waiting" && course.now_s === null) course.now_s = at_s;
    at_s += lasts_s;
  }
  return course;
}

const soaked_share = (step) => {
  if (step.frames) return Math.min(1, step.frames_saved / step.frames);
  return step.duration_s > 0 ? Math.min(1, step.soaked_s / step.duration_s) : 0;
};

function bar(step) {
  return h("progress", { max: 1, value: soaked_share(step), "aria-label": `${number(soaked_share(step) * 100, 0)} % of step ${step.index + 1}` });
}

function progress_text(step) {
  if (step.standing !== "under_way") return "";
  if (step.frames) return ` – ${step.frames_saved} of ${step.frames} frames`;
  return step.soaked_s > 0 ? ` – ${duration(step.soaked_s)} of ${duration(step.duration_s)} soaked` : "";
}

// How far the end may be off, as the stand says; "" before there is anything to go by.
export const uncertainty = (run) => (run.end_within_s ? ` ± ${duration(run.end_within_s)}` : "");
