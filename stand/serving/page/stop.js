// STOP asks nothing, waits for nothing and is repeated until the stand has confirmed it.
import { clock, say } from "./dom.js";

const AGAIN_MS = 700, LIMIT_MS = 4000, TWICE_MS = 1500;

export function arm(button, notices, app) {
  let is_trying = false;

  async function stop() {
    if (is_trying) return;
    is_trying = true;
    button.setAttribute("data-sent", "");
    const notice = notices.pressed();
    for (let tries = 1; ; tries += 1) {
      try {
        const answer = await fetch("/api/v1/run/stop", { method: "POST", keepalive: true, signal: AbortSignal.timeout(LIMIT_MS) });
        const body = await answer.json().catch(() => ({}));
        if (answer.ok) {
          say(notice.answer, `The stand answered at ${clock(app.state ? app.now_s() : Date.now() / 1000, true)}: ${body.text || "it is being made safe"}.`);
          notice.seq = Math.max(body.seq ?? 0, (app.state?.seq ?? 0) + 1);
          break;
        }
        say(notice.answer, `NOT STOPPED: ${body.error ?? answer.status}. Trying again; use the emergency stop at the stand.`);
      } catch {
        say(notice.answer, `NOT STOPPED: the stand has not answered (${tries}). Trying again; use the emergency stop at the stand.`);
      }
      await new Promise((done) => setTimeout(done, AGAIN_MS));
    }
    is_trying = false;
    setTimeout(() => button.removeAttribute("data-sent"), 15000);
  }

  // At once, with the press: not with the release, which may be elsewhere.
  button.addEventListener("pointerdown", (event) => { if (event.button === 0) stop(); });
  button.addEventListener("click", stop);
  let escape_ms = -Infinity;
  addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || event.repeat) return;
    const now_ms = performance.now();
    if (now_ms - escape_ms < TWICE_MS) stop();
    escape_ms = now_ms;
  }, true);
}
