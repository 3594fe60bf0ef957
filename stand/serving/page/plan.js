// The plan as a time line and as a list: what is done, how long soaks have lasted, what is to come and when.
import { called, commands, get, order, tell } from "./api.js";
import { ask, axes_of, clock, css, day_clock, duration, fill, h, number, say, seconds, words } from "./dom.js";
import { PlanEdit, step_schema } from "./plan_edit.js";

const SIGN = { done: "✓", under_way: "▶", waiting: "·", skipped: "⤼" };
const WORD = { done: "done", under_way: "under way", waiting: "to come", skipped: "left out" };
// Commands that have a place of their own.
const PLACED = new Set(["stop", "pause", "continue", "reset", "skip", "extend", "edit", "submit", "cancel", "move", "resume", "device", "note", "fault"]);
const SHOWN_DONE = 3;
const MOST_ROWS = 300;

export class Plan {
  constructor(place, app) {
    this.app = app;
    this.all = false;
    this.steps = [];
    this.answer = h("p", { class: "answer", role: "status" });
    this.buttons = h("div", { class: "row" },
      this.pause = called("pause", h("button", { type: "button", "data-order": "", onclick: () => this.order("pause", { when: "now" }, "pause") }), (title) => `${title} now`),
      this.pause_step = h("button", { type: "button", "data-order": "", onclick: () => this.pause_after() }, "Pause after this step"),
      this.go = called("continue", h("button", { type: "button", "data-order": "", class: "main", onclick: () => this.order("continue", undefined, "continue") })),
      this.edit_button = h("button", { type: "button", "data-order": "", onclick: () => this.edit() }, "Edit the steps to come …"),
      this.abort = h("button", { type: "button", class: "danger", onclick: () => this.end() }, "End the run …"));
    this.summary = h("p", {});
    this.line = h("canvas", { class: "line", role: "img", "aria-label": "Time line of the plan" });
    this.list = h("ol", { class: "steps" });
    this.asks = h("div", {});
    this.edits = h("div", {});
    this.more = h("div", { class: "row" });
    commands().then((known) => fill(this.more, [...known.values()].filter(({ name }) => !PLACED.has(name)).map((each) => this.form(each))), () => {});
    fill(place, h("div", { class: "stack" },
      h("section", { class: "panel" }, h("div", { class: "head" }, h("h2", {}, "Run"), this.buttons), this.more, this.summary, this.asks, this.answer, this.edits, this.line,
        h("p", { class: "quiet" }, "tall: frames are taken; low: soaks and the rest; the line is now")),
      h("section", { class: "panel" }, h("h2", {}, "Steps"), this.list)));
    this.resizing = new ResizeObserver(() => this.draw());
    this.resizing.observe(this.line);
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
    const done = steps.filter((step) => step.standing === "done" || step.standing === "skipped");
    const hide = this.all ? 0 : Math.max(0, done.length - SHOWN_DONE);
    const first = steps.findIndex((step) => step.standing === "waiting" || step.standing === "under_way");
    const begin = this.all || first < 0 ? hide : Math.max(0, first - SHOWN_DONE);
    const more = begin || this.all ? h("li", { class: "more" }, h("span"), h("span", { class: "index" }), h("button", { type: "button", class: "small", "aria-expanded": String(this.all), onclick: () => { this.all = !this.all; this.show(); } },
      this.all ? "Hide steps that are done" : begin === 1 ? "1 step before these" : `${begin} steps before these`)) : null;
    const focused = document.activeElement?.dataset?.key;
    if (this.list.querySelector(".ask")) return; // a question is open
    const shown = steps.slice(begin, begin + MOST_ROWS), rest = steps.length - begin - shown.length;
    fill(this.list, more, shown.map((step) => this.row(step)), rest > 0 ? h("li", {}, h("span"), h("span"), h("span", { class: "quiet" }, `${rest} more steps`)) : null);
    if (focused) this.list.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
    if (!steps.length) fill(this.list, h("li", {}, h("span"), h("span"), h("span", { class: "quiet" }, "No run. Start one from the queue.")));
    this.draw();
    this.update(this.app.state);
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
    if (!is_run) return say(this.summary, "No run is under way.");
    const run = state.run;
    const end = run.end_ns === null ? "" : `; ends ${day_clock(seconds(run.end_ns, run.utc_offset_ns))}${uncertainty(run)}`;
    say(this.summary, `${run.recipe}, session ${run.run_id || "–"}: step ${run.step} of ${run.steps}${is_held ? `, held: ${state.prompt ? "it waits for you" : state.reasons.map(this.app.reason).join(", ")}` : state.pausing ? ", pauses when it is done" : ""}${end}`);
  }

  draw() {
    const { line, steps } = this, scale = devicePixelRatio;
    const width = Math.floor(line.clientWidth * scale), height = Math.floor(42 * scale);
    if (!width) return;
    line.width = width;
    line.height = height;
    const context = line.getContext("2d"), total_s = steps.reduce((sum, step) => sum + step.duration_s, 0) || 1;
    let at_s = 0;
    for (const step of steps) {
      const x = (at_s / total_s) * width, wide = Math.max(1, (step.duration_s / total_s) * width);
      const is_frames = step.kind.startsWith("capture"), is_soak = step.kind.startsWith("soak") || step.kind === "cool_down";
      const part = { done: 1, skipped: 0, waiting: 0, under_way: soaked_share(step) }[step.standing];
      const top = is_frames ? 4 * scale : is_soak ? 12 * scale : 18 * scale, tall = height - 2 * top;
      context.fillStyle = is_frames ? `${css("--c-air")}88` : css("--line");
      context.fillRect(x, top, wide, tall);
      context.fillStyle = is_frames ? css("--c-air") : css("--c-granite");
      context.fillRect(x, top, wide * part, tall);
      if (step.standing === "under_way") {
        context.fillStyle = css("--ink");
        context.fillRect(x + wide * part - scale, 0, 2 * scale, height);
      }
      at_s += step.duration_s;
    }
    const count = steps.filter((step) => step.standing === "done").length;
    line.setAttribute("aria-label", steps.length ? `Time line of the plan: ${count} of ${steps.length} steps are done` : "Time line: there is no plan");
  }

  soon() { this.refresh(); }
  event(event) { if (event.kind === "step" || event.kind === "plan_changed") { clearTimeout(this.later); this.later = setTimeout(() => this.refresh(), 200); } }
  close() { this.closed = true; this.editor?.close(); clearInterval(this.timer); clearTimeout(this.later); this.resizing.disconnect(); }
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
