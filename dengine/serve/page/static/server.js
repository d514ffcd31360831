// Requests to the server's public API, and its stream of changes; all other modules use only these.

const REUSE_FACTOR = 10; // a response is reused for this many times the time it took, so that viewers cost the server little
const MAX_REUSE = 30000; // ms
const MAX_SILENCE = 12000; // ms without an event, after which the connection counts as lost: the server sends one every 5 s
const responses = new Map(); // by path: data, and until when they are reused
let nChanges = 0; // requests that changed something; responses to earlier requests are then old

export class Problem extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

// Return the response, or throw a Problem for one that is not 2xx.
async function checked(response) {
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({}));
  throw new Problem(response.status, problem.detail ?? `The server responded with ${response.status}.`);
}

export async function get(path, reusedUntil = []) {
  // Return the JSON of a GET. If an earlier response is reused, the time until which it is reused is added to `reusedUntil`.
  const earlier = responses.get(path);
  const begin = Date.now();
  const nBefore = nChanges;
  if (earlier && begin < earlier.until) {
    reusedUntil.push(earlier.until);
    return earlier.data;
  }
  const data = await (await checked(await fetch(path, { headers: { accept: "application/json" } }))).json();
  if (responses.size > 64) responses.clear();
  if (nBefore === nChanges) responses.set(path, { data, until: Date.now() + Math.min(MAX_REUSE, REUSE_FACTOR * (Date.now() - begin)) });
  return data;
}

export async function post(path, body) {
  const response = await checked(await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) }));
  responses.clear();
  nChanges += 1;
  return response;
}

export function listen(onChange, onConnection) {
  // Follow the server. onChange is called for each change; onConnection with "live" or "cut" and the time of the last event.
  let lastEvent = Date.now();
  let version = null;
  const alive = () => {
    lastEvent = Date.now();
    onConnection("live", lastEvent);
  };
  const connect = () => {
    const source = new EventSource("changes");
    source.addEventListener("hello", (event) => {
      alive();
      if (version !== null && version !== event.data) location.reload(); // another version of the server has other scripts
      version = event.data;
    });
    source.addEventListener("changed", () => { alive(); onChange(); });
    source.addEventListener("tick", alive);
    source.addEventListener("error", () => {
      onConnection("cut", lastEvent);
      if (source.readyState === EventSource.CLOSED) setTimeout(connect, 2000); // refused, so that the browser does not connect again
    });
  };
  connect();
  setInterval(() => { if (Date.now() - lastEvent > MAX_SILENCE) onConnection("cut", lastEvent); }, 1000);
}
