// Requests. Every command says in a sentence what came of it, under the buttons it belongs to.
const BASE = "/api/v1";

export class Refused extends Error {}

export async function get(path) {
  const answer = await fetch(BASE + path, { headers: { accept: "application/json" } });
  return read(answer);
}

async function read(answer) {
  if (answer.status === 204) return null;
  const body = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Refused(body.error ?? `the stand answered ${answer.status}`);
  return body;
}

export async function send(method, path, body) {
  const answer = await fetch(BASE + path, {
    method,
    headers: body === undefined ? {} : { "content-type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  return read(answer);
}

// What may be ordered, by name: where, and what it is called.
let table = null;
const STOP = { method: "POST", path: `${BASE}/run/stop` }; // which waits for no table
export function commands() {
  table ??= get("/commands").then((found) => new Map(found.map((each) => [each.name, each])));
  table.catch(() => { table = null; });
  return table;
}

// A button that is called as the service calls its command. `text`: with what else; `label`: for who does not see it.
export function called(name, button, text = (title) => title, label = null) {
  if (button.dataset.order === "") button.dataset.order = name;
  commands().then((known) => known.get(name).title, () => name).then((title) => {
    button.textContent = text(title);
    if (label) button.setAttribute("aria-label", label(title));
  });
  return button;
}

// Orders the command of that name with what its argument takes; `label`: what it is called here. `place` gets the
// outcome; returns the answer, or null when it was refused.
export async function order(place, name, given = {}, label = name) {
  tell(place, `${label} …`);
  try {
    const { method, path } = name === "stop" ? STOP : (await commands()).get(name), body = { ...given };
    const at = path.slice(BASE.length).replace(/{(\w+)}/g, (_, field) => {
      const value = body[field];
      delete body[field];
      return encodeURIComponent(value);
    });
    const answer = await send(method, at, Object.keys(body).length ? body : undefined);
    const moving = answer.moving?.length ? `; still moving: ${answer.moving.join(", ")}` : "";
    tell(place, (answer.text || `${label}: done`) + moving);
    return answer;
  } catch (error) {
    tell(place, error instanceof Refused ? error.message : `the stand could not be reached (${error.message})`, true);
    return null;
  }
}

export function tell(place, text, is_error = false) {
  place.textContent = text;
  place.classList.toggle("error", is_error);
}
