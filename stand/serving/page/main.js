// The page: a header that is always there, one view below it, and the stream that both follow.
import { Devices } from "./devices.js";
import { clock, day_clock, say, seconds } from "./dom.js";
import { CameraView } from "./frame.js";
import { Notices, reason } from "./notices.js";
import { Now } from "./now.js";
import { Overview } from "./overview.js";
import { Plan, uncertainty } from "./plan.js";
import { Queue } from "./queue.js";
import { Sessions } from "./sessions.js";
import { arm } from "./stop.js";
import { follow } from "./stream.js";
import { look_who } from "./looking.js";

const VIEWS = { now: Now, plan: Plan, queue: Queue, camera: CameraView, sessions: Sessions, devices: Devices, stands: Overview };
const PHASE = { idle: "Idle", by_hand: "Heat by hand", running: "Running", held: "Held", stopping: "Stopping", tripped: "Tripped", lost: "No connection" };
const at = (id) => document.getElementById(id);

const app = {
  state: null,
  view: null,
  is_lost: true,
  reason,
  // Now, as the stand has it; between two states the browser's clock goes on.
  now_s() {
    return seconds(this.state.now_ns, this.state.utc_offset_ns) + (performance.now() - this.state_ms) / 1000;
  },
  cameras() {
    return this.state?.cameras ?? [];
  },
};
const notices = new Notices(at("notices"), app);

function open() {
  const name = location.hash.slice(1) in VIEWS ? location.hash.slice(1) : "now";
  app.view?.close();
  for (const link of document.querySelectorAll("nav a")) {
    link.hash === `#${name}` ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  app.view = new VIEWS[name](at("view"), app);
  if (app.state) app.view.update(app.state);
}

function show(state) {
  app.state = state;
  app.state_ms = performance.now();
  const phase = state.fault ? "tripped" : state.by_hand ? "by_hand" : state.phase;
  say(at("stand"), state.stand);
  at("simulated").hidden = !state.simulated;
  at("phase").dataset.phase = phase;
  say(at("phase"), PHASE[phase]);
  const { run } = state;
  say(at("doing"), run ? `${run.recipe}: step ${run.step} of ${run.steps}, ${run.doing}` : phase === "running" ? "a run begins" : between_runs(state));
  say(at("eta"), run?.end_ns ? `ends ${day_clock(seconds(run.end_ns, run.utc_offset_ns))}${uncertainty(run)}` : clock(app.now_s()));
  document.title = `${PHASE[phase]} · ${state.stand}`;
  notices.update(state);
  app.view.update(state);
}

// What was ordered by hand is known also while the regulator does not answer; else what that says it does.
function between_runs({ by_hand, setpoint_degC, utc_offset_ns }) {
  if (by_hand) {
    const since = `set to ${by_hand.setpoint_degC} °C, on since ${day_clock(seconds(by_hand.since_ns, utc_offset_ns))}`;
    return by_hand.cut_ns === null ? since : `${since}; heat cut by the relay board's timer at ${day_clock(seconds(by_hand.cut_ns, utc_offset_ns))}`;
  }
  return setpoint_degC === null ? "no run" : `no run; chamber at ${setpoint_degC} °C`;
}

function lost() {
  app.is_lost = true;
  document.body.classList.add("lost");
  at("phase").dataset.phase = "lost";
  say(at("phase"), PHASE.lost);
  const since = app.state ? `What is shown is of ${clock(seconds(app.state.now_ns, app.state.utc_offset_ns), true)}. ` : "";
  notices.lost(`${since}Trying again. The stand guards itself; to stop it now, press STOP or its emergency stop.`);
  look();
}

const look = () => look_who((text) => notices.looks(text));

arm(at("stop"), notices, app);
look();
addEventListener("hashchange", open);
document.addEventListener("visibilitychange", () => { if (!document.hidden) app.view?.soon?.(); });
open();
follow({
  state: show,
  event: (event) => app.view.event(event),
  reading: () => {},
  gone: () => app.view.soon?.(),
  lost,
  back: () => {
    app.is_lost = false;
    document.body.classList.remove("lost");
    notices.lost("");
    look();
    setTimeout(() => app.view.soon?.(), 300);
  },
});
