// Requests to the server and its events, with the API key if the server asks for one.

export const pause = ms => new Promise(done => setTimeout(done, ms));

// The server asks for a key, or refuses the one that it got.
export class Locked extends Error {}

export class ApiError extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

// The tab keeps the key and sends it in headers, never in a URL.
let key = sessionStorage.getItem("key");
let whenLocked = () => {};
export const onLocked = listener => { whenLocked = listener; };
export const hasKey = () => key !== null;

// A browser cannot set headers of a WebSocket, so the key is sent as a sub-protocol.
export const keyProtocols = () => (key ? [`foreframe.key.${key}`] : []);
const authorization = () => (key ? { Authorization: `Bearer ${key}` } : {});

function lock(why) {
  key = null;
  sessionStorage.removeItem("key");
  whenLocked(why);
}

// Uses a key that somebody typed. Returns what is wrong with it, or an empty text.
export async function unlock(text) {
  if (!/^ffk_[0-9a-f]+_[\w-]+$/.test(text)) {
    return "This is not a key. A key looks like ffk_0123456789ab_… and is shown once, when it is created.";
  }
  const response = await fetch("/v1/models", { headers: { Authorization: `Bearer ${text}` } }).catch(() => null);
  if (!response) return "The server does not answer.";
  if (response.status === 401) return "This key is unknown or was revoked.";
  key = text;
  sessionStorage.setItem("key", key);
  return "";
}

async function checked(response, used) {
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({ detail: response.statusText }));
  if (response.status !== 401) throw new ApiError(response.status, problem.detail);
  // An answer to an older key says nothing about the present one.
  if (used === key) lock(used ? "This key is unknown or was revoked." : "");
  throw new Locked(problem.detail);
}

async function request(path, options = {}) {
  const used = key;
  const response = await fetch(path, { ...options, headers: { ...options.headers, ...authorization() } })
    .catch(cause => { throw new Error("The server does not answer; try again.", { cause }); });
  return checked(response, used);
}

export async function call(method, path, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const response = await request(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  return response.status === 204 ? null : response.json();
}

// Sends a file: `done` is the answer, `stop` breaks it off, `onProgress` gets the share that was sent, which fetch does not tell.
export function upload(path, file, onProgress) {
  const used = key, sender = new XMLHttpRequest();
  const done = new Promise((resolve, reject) => {
    const headers = { "Content-Type": "application/octet-stream", ...authorization() };
    sender.open("POST", path);
    for (const [name, value] of Object.entries(headers)) sender.setRequestHeader(name, value);
    sender.upload.onprogress = ({ loaded, total }) => onProgress(loaded / total);
    sender.onload = () => checked(new Response(sender.responseText, { status: sender.status }), used).then(answer => answer.json()).then(resolve, reject);
    sender.onerror = () => reject(new Error("The connection ended while the file was sent. It may be larger than the server takes (max_upload_mib)."));
    sender.onabort = () => reject(new Error("The upload was stopped."));
    sender.send(file);
  });
  return { done, stop: () => sender.abort() };
}

export const get = path => call("GET", path);
export const text = async path => (await request(path)).text();
export const blob = async path => (await request(path)).blob();

// Deletes something while the page closes: the request outlives the page.
export const deleteAtEnd = path => fetch(path, { method: "DELETE", keepalive: true, headers: authorization() }).catch(() => null);

// All entries of a list that comes in pages.
export async function all(path, name, limit = 1000) {
  const entries = [];
  for (let after = ""; ;) {
    const page = await get(`${path}?limit=${limit}${after && `&after=${encodeURIComponent(after)}`}`);
    entries.push(...page[name]);
    if (!page.next) return { ...page, [name]: entries };
    after = page.next;
  }
}

const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 4000;

// Listens to server-sent events, and connects again when the connection is lost. EventSource cannot send the key. `on(name, data)` gets
// every event, "open", "lost", and "refused" with the reason if there is nothing to listen to; it returns true after the last event that
// it wants.
export function listen(path, on) {
  const stop = new AbortController();
  follow(path, on, stop.signal).catch(() => {});
  return () => stop.abort();
}

async function follow(path, on, signal) {
  let last, wait_ms = FIRST_WAIT_MS;
  while (!signal.aborted) {
    try {
      const headers = last ? { "Last-Event-ID": last } : {};
      const response = await request(path, { headers, signal });
      on("open");
      wait_ms = FIRST_WAIT_MS;
      for await (const event of events(response.body)) {
        if (event.id) last = event.id;
        if (on(event.name, event.data)) return stopReading(response);
      }
    } catch (error) {
      // Neither is worth another try: a key is missing, or there is nothing there. A rate limit is.
      if (error instanceof Locked) return;
      if (error instanceof ApiError && error.status < 500 && error.status !== 429) {
        on("refused", error.message);
        return;
      }
    }
    if (signal.aborted) return;
    on("lost");
    await pause(wait_ms);
    wait_ms = Math.min(wait_ms * 1.5, LONGEST_WAIT_MS);
  }
}

const stopReading = response => response.body.cancel().catch(() => {});

async function* events(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  for (let rest = ""; ;) {
    const { value, done } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const fields = Object.fromEntries(block.split("\n").map(line => line.split(/: ?(.*)/s)));
      if (fields.event) yield { name: fields.event, id: fields.id, data: JSON.parse(fields.data || "null") };
    }
  }
}
