// What needs somebody: a fault, a prompt, a pause, a connection that is lost. Below the header, never over STOP.
import { called, order } from "./api.js";
import { temperatures, look_of } from "./channels.js";
import { clock, day_clock, fill, h, number, say, seconds, unit_of, words } from "./dom.js";

// What holds a run (stand/safety/gate.py), and what ends that by itself.
const REASON = {
  operator: "paused by an operator", interlock: "a fault has tripped", camera_lost: "a camera does not answer",
  disk_low: "the disk takes no frames", not_recorded: "the disk takes no telemetry", stopping: "the run is being ended",
};
const ENDS = {
  camera_lost: "It goes on when the camera answers: look at its cable and supply.",
  disk_low: "It goes on when there is space: stand session archive copies what is finished elsewhere.",
  not_recorded: "It goes on when the disk takes what waits: see that it is mounted, has space and answers.",
};
// What the guard does about a fault: FaultState.data of a rule of the stand.
const DOES = {
  abort: () => "It ends a run, which can be resumed once this is reset.",
  hold: ({ ends_itself }) => (ends_itself ? "It holds a run, which goes on by itself when this is over." : "It holds a run until somebody resets this."),
  warn: () => "It says so, and stops nothing.",
};
const FIRST = ["unsafe", "lost"]; // all else is of before while the connection is lost
export const reason = (name) => REASON[name] ?? words(name);

export class Notices {
  constructor(place, app) {
    this.app = app;
    this.place = place;
    this.parts = {};
  }

  // One notice of each kind, made when there is cause and removed when there is none; never made again while it is there.
  set(kind, key, make) {
    const part = this.parts[kind];
    if (part?.key === key) return part;
    part?.element.remove();
    delete this.parts[kind];
    if (!key) return null;
    const made = { key, ...make() };
    this.parts[kind] = made;
    FIRST.includes(kind) ? this.place.prepend(made.element) : this.place.append(made.element);
    return made;
  }

  update(state) {
    const { fault, prompt, not_confirmed } = state;
    const is_failing = not_confirmed.some(({ reason }) => reason);
    this.set("unsafe", not_confirmed.length && `${is_failing} ${not_confirmed.map(({ name }) => name)}`, () => this.unsafe(state, is_failing))?.refresh(state);
    const tripped = this.set("fault", fault && `${fault.rule} ${fault.since_ns}`, () => this.fault(state));
    tripped?.refresh(state);
    this.set("prompt", prompt && `${prompt.step_id} ${prompt.text}`, () => this.prompt(prompt));
    const held = state.run && !fault && !prompt && state.reasons.length ? state.reasons.join() : "";
    this.set("held", held, () => this.held(state))?.refresh(state);
    this.stopped(state);
    this.set("queue", !state.run && state.queue_halted, () => this.halted(state));
  }

  lost(text) {
    this.set("lost", text, () => ({ element: h("section", { class: "notice error", role: "alert" }, h("h2", {}, "No connection to the stand"), h("p", {}, text)) }));
  }

  // Why nothing can be ordered, or nothing is shown.
  looks(text) {
    this.set("looks", text, () => ({ element: h("section", { class: "notice", role: "status" }, h("p", {}, text)) }));
  }

  // What was to be made safe and has not confirmed it: each try may find another reason.
  unsafe({ not_confirmed }, is_failing) {
    const names = not_confirmed.map(({ name }) => words(name)).join(", ");
    const parts = not_confirmed.map(() => h("p", {}));
    const element = h("section", { class: `notice ${is_failing ? "error" : "warning"}`, role: "alert" },
      h("h2", {}, is_failing ? `Not yet confirmed safe: ${names}` : `Being made safe: ${names}`), parts);
    return { element, refresh: (now) => parts.forEach((part, index) => say(part, not_yet(now.not_confirmed[index], now))) };
  }

  fault(state) {
    const { fault } = state;
    const answer = h("p", { class: "answer", role: "status" });
    const review = h("div", { hidden: true });
    const readings = h("dl", { class: "facts" });
    const reset = called("reset", h("button", { type: "button", class: "main", "data-order": "", onclick: () => order(answer, "reset") }), (title) => `The cause is removed: ${title.toLowerCase()}`);
    const open = h("button", { type: "button", "aria-expanded": "false", onclick: () => {
      review.hidden = !review.hidden;
      open.setAttribute("aria-expanded", String(!review.hidden));
    } }, "Look at it and reset …");
    const { action, ends_itself, ...measured } = fault.data ?? {};
    const does = DOES[action]?.({ ends_itself }), data = Object.entries(measured).filter(([, value]) => typeof value !== "object");
    fill(review, h("div", { class: "row" }, h("div", { class: "grow" }, h("h3", {}, "What tripped"),
      h("dl", { class: "facts" }, [["rule", words(fault.rule)], ["found", fault.text], ["at", clock(seconds(fault.since_ns, state.utc_offset_ns), true)], ...(does ? [["the guard", does]] : []), ...data.map(([name, value]) => [words(name), String(value)])].map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]))),
      h("div", { class: "grow" }, h("h3", {}, "Readings now"), readings)), h("div", { class: "row" }, reset));
    const since = h("p", {});
    const element = h("section", { class: "notice error", role: "alert" }, h("h2", {}, `Tripped: ${words(fault.rule)}`), h("p", {}, fault.text),
      since, h("div", { class: "row" }, open), review, answer);
    return { element, refresh: (now) => {
      const safe = now.not_confirmed.length ? "That the stand is safe is not yet confirmed." : "The stand is made safe.";
      say(since, `Since ${day_clock(seconds(fault.since_ns, now.utc_offset_ns))}. ${safe}`);
      this.readings(readings, now);
    } };
  }

  readings(place, state) {
    const channels = temperatures(Object.fromEntries(Object.entries(state.readings).map(([name, { unit }]) => [name, unit])));
    const rows = [...channels.map((channel) => [look_of(channel).name, of(state.readings[channel])]),
      ["heater", state.heater_permitted ? "permitted" : "not permitted"], ["compressor", state.compressor_on ? "running" : "off"], ["flap", state.flap || "unknown"]];
    if (place.children.length !== 2 * rows.length) fill(place, rows.map(([name]) => [h("dt", {}, name), h("dd", {}, "")]));
    rows.forEach(([, text], index) => say(place.children[2 * index + 1], text));
  }

  prompt({ text }) {
    const answer = h("p", { class: "answer", role: "status" });
    const element = h("section", { class: "notice warning", role: "alert" }, h("h2", {}, "The run waits for you"), h("p", {}, text),
      h("div", { class: "row" }, h("button", { type: "button", class: "main", "data-order": "", onclick: () => order(answer, "continue") }, "Done, go on")), answer);
    return { element };
  }

  // STOP was pressed: when, and below it what the stand answers and what it has confirmed. It stays until a run begins.
  pressed() {
    const at_s = this.app.state ? this.app.now_s() : Date.now() / 1000;
    const answer = h("p", {}, "stopping …"), outcome = h("p", {});
    return this.set("stop", `stop ${Date.now()}`, () => ({ answer, outcome, seq: Infinity, element: h("section", { class: "notice error", role: "alert" },
      h("h2", {}, `STOP, pressed at ${clock(at_s, true)}`), answer, outcome,
      h("div", { class: "row" }, h("button", { type: "button", class: "small", onclick: () => this.set("stop", "", null) }, "Put this away"))) }));
  }

  // seq: of the command that stopped; what the stand says of before it confirms nothing.
  stopped(state) {
    const made = this.parts.stop;
    if (!made || state.seq < made.seq) return;
    if (made.is_confirmed) { if (state.phase === "running") this.set("stop", "", null); return; }
    const names = state.not_confirmed.map(({ name }) => words(name)).join(", ");
    if (names) return say(made.outcome, `Not yet confirmed safe: ${names}.`);
    made.is_confirmed = true;
    made.element.classList.replace("error", "warning");
    say(made.outcome, `Confirmed at ${clock(this.app.now_s(), true)}: ${confirmed(state)}.`);
  }

  halted(state) {
    const answer = h("p", { class: "answer", role: "status" });
    const button = h("button", { type: "button", "data-order": "reset", onclick: () => order(answer, "reset", {}, "go on") }, "Go on with the queue");
    return { element: h("section", { class: "notice warning" }, h("h2", {}, "The queue is halted"), h("p", {}, state.queue_halted), h("div", { class: "row" }, button), answer) };
  }

  held(state) {
    const answer = h("p", { class: "answer", role: "status" });
    const is_mine = state.reasons.includes("operator");
    const button = called("continue", h("button", { type: "button", class: "main", "data-order": "", onclick: () => order(answer, "continue") }));
    const text = h("p", {});
    const element = h("section", { class: "notice warning" }, h("h2", {}, `The run is held: ${state.reasons.map(reason).join("; ")}`),
      text, is_mine ? h("div", { class: "row" }, button) : null, answer);
    return { element, refresh: (now) => say(text, [...now.reasons.map((name) => ENDS[name]), chamber_of(now)].filter(Boolean).join(" ")) };
  }
}

// What is known of the chamber: a set-point that is not read is not one that is not held.
function chamber_of({ heater_permitted, setpoint_degC, readings }) {
  if (!heater_permitted) return "Heat and cold are not permitted.";
  if (setpoint_degC !== null) return "The chamber keeps its set-point.";
  if (readings["regulator.running"]?.value === 0) return "The regulator is stopped.";
  return "Heat and cold are permitted; the regulator's set-point is not known now.";
}

// The safe state of each part that there is (stand/safety/making_safe.py): each has confirmed it.
function confirmed({ flap, axes }) {
  const stages = Object.keys(axes).map(words);
  const parts = ["heat and cold are off", flap === "none" ? "" : "the flap is closed", stages.length ? `the stages (${stages.join(", ")}) stand still` : ""];
  return parts.filter(Boolean).join(", ");
}

function not_yet({ name, since_ns, reason, timer_s }, { utc_offset_ns }) {
  const since = `Since ${clock(seconds(since_ns, utc_offset_ns), true)}`;
  if (!reason) return `${since}: ${words(name)} is being made safe.`;
  const timer = timer_s === null ? "" : ` Heat and cold cannot be switched off through it now: the relay board's own timer ends them, at the latest ${timer_s} s after that time.`;
  return `${since}: ${reason}. It is tried again until it confirms.${timer}`;
}

const of = (reading) => (reading.value === null ? `no reading: ${reading.reason}` : `${number(reading.value, 2)} ${unit_of(reading.unit)}`);
