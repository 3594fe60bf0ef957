// What somebody's role is not enough for ([data-order], the command's name; [data-role]) stays disabled, whatever the views say, and says why. STOP is no such thing.
import { Refused, commands, get } from "./api.js";

const ROLES = ["look", "operate", "commission"];
let mine = null, needs = new Map();

const who = ({ name, how }) => (how === "proxy" ? name : name ? `The token of ${name}` : "This machine, without a token,");

function disable(root) {
  for (const control of root.querySelectorAll("[data-order]")) {
    const needed = control.dataset.role ?? needs.get(control.dataset.order) ?? "operate";
    if (ROLES.indexOf(mine.role) >= ROLES.indexOf(needed)) continue;
    const why = `This needs the role ${needed}. ${who(mine)} has the role ${mine.role}.`;
    if (!control.disabled) control.disabled = true;
    if (control.title !== why) control.title = why;
  }
}

// `tell` is given why nothing can be ordered; "" when it can be. Asked again with each connection: a token may be taken back meanwhile.
export async function look_who(tell) {
  let known;
  try { known = await get("/who"); } catch (error) { return error instanceof Refused && tell(error.message); }
  tell(known.role === "look" ? `${who(known)} may look and press STOP, but order nothing.` : "");
  if (mine || known.role === ROLES.at(-1)) return;
  mine = known;
  needs = await commands().then((table) => new Map([...table].map(([name, { role }]) => [name, role])), () => needs);
  disable(document);
  new MutationObserver(() => disable(document)).observe(document.body, { subtree: true, childList: true, attributes: true, attributeFilter: ["disabled", "data-order"] });
}
