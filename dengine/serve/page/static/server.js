// What is asked of the server: its public API and its stream of changes, and nothing else.

const REST = 10; // an answer that took a second is not asked for anew for so many: looking on is not to be felt
const LONGEST = 30000; // ms of such a rest at most
const SILENCE = 12000; // ms without a word, after which the line counts as cut: the server says something every 5 s
const kept = new Map(); // by address: an answer, and until when it rests
let done = 0; // requests that changed something: what was asked before is old then

export class Problem extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

async function checked(answer) {
  if (answer.ok) return answer;
  const said = await answer.json().catch(() => ({}));
  throw new Problem(answer.status, said.detail ?? `The server answered ${answer.status}.`);
}

export async function get(path, rests = []) {
  // The answer to a question; an address whose answer is taken again says in `rests` when it may be asked anew.
  const was = kept.get(path);
  const begin = Date.now();
  const before = done;
  if (was && begin < was.until) {
    rests.push(was.until);
    return was.said;
  }
  const said = await (await checked(await fetch(path, { headers: { accept: "application/json" } }))).json();
  if (kept.size > 64) kept.clear();
  if (before === done) kept.set(path, { said, until: Date.now() + Math.min(LONGEST, REST * (Date.now() - begin)) });
  return said;
}

export async function post(path, body) {
  const answer = await checked(await fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) }));
  kept.clear();
  done += 1;
  return answer;
}

export function listen(changed, lineIs) {
  // Follow the server. changed : called for each change.  lineIs : with "live" or "cut", and when it was heard of last.
  let heard = Date.now();
  let version = null;
  const alive = () => {
    heard = Date.now();
    lineIs("live", heard);
  };
  const connect = () => {
    const source = new EventSource("changes");
    source.addEventListener("hello", (event) => {
      alive();
      if (version !== null && version !== event.data) location.reload(); // another release: another script
      version = event.data;
    });
    source.addEventListener("changed", () => { alive(); changed(); });
    source.addEventListener("tick", alive);
    source.addEventListener("error", () => {
      lineIs("cut", heard);
      if (source.readyState === EventSource.CLOSED) setTimeout(connect, 2000); // refused, not only interrupted
    });
  };
  connect();
  setInterval(() => { if (Date.now() - heard > SILENCE) lineIs("cut", heard); }, 1000);
}
