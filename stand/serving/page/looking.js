// Who may only look: what orders something ([data-order]) stays disabled, whatever the views say, and says why. STOP is no such thing.
import { Refused, get } from "./api.js";

let why = "";

function disable(root) {
  for (const control of root.querySelectorAll("[data-order]")) {
    if (!control.disabled) control.disabled = true;
    if (control.title !== why) control.title = why;
  }
}

// `tell` is given why nothing can be ordered; "" when it can be. Asked again with each connection: a token may be taken back meanwhile.
export async function look_who(tell) {
  let known;
  try { known = await get("/who"); } catch (error) { return error instanceof Refused && tell(error.message); }
  if (!known.read_only || why) return tell(why);
  why = `${known.name ? `The token of ${known.name}` : "This machine, without a token,"} may look and press STOP, but order nothing.`;
  disable(document);
  new MutationObserver(() => disable(document)).observe(document.body, { subtree: true, childList: true, attributes: true, attributeFilter: ["disabled"] });
  tell(why);
}
