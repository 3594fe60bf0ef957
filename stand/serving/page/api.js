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

export async function send(method, path, body, headers = {}) {
  const answer = await fetch(BASE + path, {
    method,
    headers: body === undefined ? headers : { "content-type": "application/json", ...headers },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  return read(answer);
}

// `place` gets the outcome; returns the answer, or null when it was refused.
export async function command(place, text, method, path, body, headers) {
  tell(place, `${text} …`);
  try {
    const answer = await send(method, path, body, headers);
    const moving = answer.moving?.length ? `; still moving: ${answer.moving.join(", ")}` : "";
    tell(place, (answer.text || `${text}: done`) + moving);
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
