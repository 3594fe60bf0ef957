// STOP asks nothing, waits for nothing and is tried until the stand has said that it heard.
import { h, say } from "./dom.js";

const AGAIN_MS = 700, LIMIT_MS = 4000, TWICE_MS = 1500;

export function arm(button, notices) {
  let is_trying = false;

  async function stop() {
    if (is_trying) return;
    is_trying = true;
    button.setAttribute("data-sent", "");
    const notice = notices.set("stop", String(Date.now()), () => {
      const text = h("p", {}, "stopping …");
      return { text, element: h("section", { class: "notice error", role: "alert" }, h("h2", {}, "STOP"), text) };
    });
    for (let tries = 1; ; tries += 1) {
      try {
        const answer = await fetch("/api/v1/run/stop", { method: "POST", keepalive: true, signal: AbortSignal.timeout(LIMIT_MS) });
        const body = await answer.json().catch(() => ({}));
        if (answer.ok) { say(notice.text, body.text || "The stand is being made safe."); break; }
        say(notice.text, `NOT STOPPED: ${body.error ?? answer.status}. Trying again; use the emergency stop at the stand.`);
      } catch {
        say(notice.text, `NOT STOPPED: the stand has not answered (${tries}). Trying again; use the emergency stop at the stand.`);
      }
      await new Promise((done) => setTimeout(done, AGAIN_MS));
    }
    is_trying = false;
    setTimeout(() => { button.removeAttribute("data-sent"); if (!is_trying) notices.set("stop", "", null); }, 15000);
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
