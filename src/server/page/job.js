// A background job: its progress by server-sent events, its log, its losses and its report.

import { html, useEffect, useRef, useState } from "./preact.js";
import { blob, call, get, listen, text } from "./api.js";
import { useLists } from "./server_lists.js";

const FINAL = ["succeeded", "failed", "cancelled"];
export const isFinal = job => FINAL.includes(job.state);
// Whether a job trains a model.
export const isTraining = ({ spec }) => ["train", "adapt"].includes(spec.kind);

// An evaluation has the model's version from its first attempt on.
export const titleOf = ({ kind, name, model, version, dataset }) => `${kind} ${name ?? model}${version ? ` version ${version}` : ""}${dataset ? ` on ${dataset}` : ""}`;

// Lines of a log that are kept.
const MOST_LINES = 500;
// Losses are read again after an event, but not more often than this.
const LOSSES_EVERY_MS = 1000;

const UNKNOWN = { job: null, lines: [], losses: [], wrong: "" };

// The job as it is now, its log and its losses; nothing without an id. `again` listens again: the events of a job end with it, and a
// resumed job has new ones.
export function useJob(id) {
  const [known, setKnown] = useState(UNKNOWN);
  const [turn, setTurn] = useState(0);
  const again = () => setTurn(now => now + 1);
  const listed = useLists().jobs?.find(job => job.id === id);
  // Another page may have resumed it.
  useEffect(() => {
    if (listed && !isFinal(listed) && known.job && isFinal(known.job)) again();
  }, [listed?.state, listed?.attempts]);
  useEffect(() => {
    if (!id) {
      setKnown(UNKNOWN);
      return undefined;
    }
    // The log comes from its first line; the rest is shown until it is read again.
    setKnown(now => ({ ...now, lines: [], wrong: "" }));
    let read_ms = -Infinity, is_gone = false;
    const readLosses = async () => {
      read_ms = performance.now();
      const { points } = await get(`/v1/jobs/${id}/metrics`).catch(() => ({ points: [] }));
      if (!is_gone) setKnown(now => ({ ...now, losses: points }));
    };
    const stop = listen(`/v1/jobs/${id}/events`, (name, data) => {
      if (name === "log") setKnown(now => ({ ...now, lines: [...now.lines, data].slice(-MOST_LINES) }));
      if (name === "refused") setKnown(now => ({ ...now, wrong: data }));
      if (name !== "job") return false;
      setKnown(now => ({ ...now, job: data }));
      const is_over = isFinal(data);
      if (isTraining(data) && (is_over || performance.now() - read_ms > LOSSES_EVERY_MS)) readLosses();
      return is_over;
    });
    return () => {
      is_gone = true;
      stop();
    };
  }, [id, turn]);
  return { ...known, again };
}

export const duration = seconds => (seconds < 90 ? `${Math.ceil(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`);

export function Progress({ job }) {
  const { done, total, remaining_s, message } = job.progress;
  const is_running = job.state === "running";
  const state = job.state === "queued" ? "waits for its turn" : job.state;
  const words = [total ? `${done} of ${total}` : "", is_running ? message : state, is_running && remaining_s != null ? `${duration(remaining_s)} left` : "",
    job.losses.train == null ? "" : `loss ${job.losses.train.toPrecision(3)}`].filter(Boolean);
  // Without a value, the bar says that the total is unknown.
  const value = total ? { max: total, value: done } : is_running ? {} : { max: 1, value: 0 };
  return html`<div><progress aria-label=${`progress of ${titleOf(job.spec)}`} ...${value} />
    <p class="quiet">${words.join(", ")}${job.cancelling && is_running ? "; stopping" : ""}</p>${job.error && html`<p class="wrong">${job.error}</p>`}</div>`;
}

// Cancel or resume, whichever fits. `onResume` is called when the job goes on.
export function Steer({ job, onResume }) {
  const [wrong, setWrong] = useState("");
  const ask = (what, then) => () => call("POST", `/v1/jobs/${job.id}/${what}`).then(() => { setWrong(""); then?.(); }, error => setWrong(error.message));
  return html`${!isFinal(job) && !job.cancelling && html`<button class="small" onClick=${ask("cancel")}>Cancel</button>`}
    ${["failed", "cancelled"].includes(job.state) && html`<button class="small" onClick=${ask("resume", onResume)}>Resume</button>`}
    ${wrong && html`<span class="wrong">${wrong}</span>`}`;
}

// The newest line is in sight.
export function Log({ lines }) {
  const place = useRef();
  useEffect(() => { place.current.scrollTop = place.current.scrollHeight; }, [lines.length]);
  return html`<pre class="log" ref=${place} tabindex="0" aria-label="log">${lines.map(({ line }) => `${line}\n`)}${lines.length ? "" : "no lines yet"}</pre>`;
}

// A picture of the server, with the key.
export function ServerPicture({ path, alt }) {
  const [url, setUrl] = useState(null);
  useEffect(() => {
    let made = null, is_gone = false;
    blob(path).then(picture => { if (!is_gone) setUrl(made = URL.createObjectURL(picture)); }, () => {});
    return () => {
      is_gone = true;
      if (made) URL.revokeObjectURL(made);
    };
  }, [path]);
  return url ? html`<img src=${url} alt=${alt} />` : html`<span class="quiet">${alt}…</span>`;
}

// An HTML page of the server inside this one: its styles apply only to it, and its scripts do not run.
export function Embedded({ path, label }) {
  const place = useRef();
  const [state, setState] = useState("drawing…");
  useEffect(() => {
    let is_gone = false;
    setState("drawing…");
    patiently(path).then(page => {
      if (is_gone) return;
      // Style elements in the text would break this page's security policy.
      const styles = [...page.matchAll(/<style>(.*?)<\/style>/gs)].map(([, rules]) => sheet(rules));
      const parsed = new DOMParser().parseFromString(page.replaceAll(/<style>.*?<\/style>/gs, ""), "text/html");
      const root = place.current.shadowRoot ?? place.current.attachShadow({ mode: "open" });
      root.adoptedStyleSheets = styles;
      const body = Object.assign(document.createElement("div"), { className: "body" });
      body.append(...parsed.body.childNodes);
      root.replaceChildren(body);
      setState("");
    }, error => setState(error.message));
    return () => { is_gone = true; };
  }, [path]);
  return html`<div>${state && html`<p class="quiet">${state}</p>`}<div ref=${place} role="region" aria-label=${label} /></div>`;
}

const TRIES = 10;

// The server draws on after the request's deadline, and keeps the page: the next request gets it.
async function patiently(path) {
  for (let tries = 1; ; tries++) {
    try {
      return await text(path);
    } catch (error) {
      if (error.status !== 408 || tries === TRIES) throw error;
    }
  }
}

function sheet(rules) {
  const made = new CSSStyleSheet();
  made.replaceSync(`${rules.replaceAll(":root", ":host").replaceAll(/(^|[\s,}])body(?=[\s,{])/g, "$1.body")} .body { max-width: none; margin: 0; padding: 0; }`);
  return made;
}

// The report of an evaluation.
export function Report({ job }) {
  const files = job.result?.files ?? [];
  const path = file => `/v1/jobs/${job.id}/files/${file}`;
  return files.includes("report.md") ? html`<div class="actions"><${Download} path=${path("report.md")} name=${`report-${job.id}.md`}>download the report<//>
    <${Download} path=${path("report.json")} name=${`report-${job.id}.json`}>its numbers as JSON<//></div>
    <${Markdown} path=${path("report.md")} picture=${path} />` : null;
}

// Saves a file of the server. A link could not send the key.
function Download({ path, name, children }) {
  const [wrong, setWrong] = useState("");
  const save = async () => {
    const url = URL.createObjectURL(await blob(path));
    Object.assign(document.createElement("a"), { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
  };
  return html`<button class="small" onClick=${() => save().then(() => setWrong(""), error => setWrong(error.message))}>${children}</button>
    ${wrong && html`<span class="wrong">${wrong}</span>`}`;
}

// What a report in Markdown uses: headings, paragraphs, lists, tables and pictures.
function Markdown({ path, picture }) {
  const [blocks, setBlocks] = useState([]);
  useEffect(() => {
    text(path).then(words => setBlocks(blocksOf(words)), error => setBlocks([error.message]));
  }, [path]);
  const [summary, ...sections] = sectionsOf(blocks);
  const drawn = some => some.map(block => html`<${Block} text=${block.trim()} picture=${picture} />`);
  return html`<div class="report">${drawn(summary)}${sections.map(([heading, ...rest], place) => html`
    <details open=${place === 0}><summary><${Block} text=${heading.trim()} picture=${picture} /></summary>${drawn(rest)}</details>`)}</div>`;
}

// The parts between empty lines. A table is a part of its own, also directly after a line of text.
const blocksOf = words => words.replaceAll(/^([^|\n].*)\n(?=\|)/gm, "$1\n\n").split(/\n{2,}/);

// The blocks before the first heading of the second level, and those of each such heading.
function sectionsOf(blocks) {
  const sections = [[]];
  for (const block of blocks) {
    if (block.trim().startsWith("## ")) sections.push([]);
    sections.at(-1).push(block);
  }
  return sections;
}

function Block({ text: words, picture }) {
  const heading = words.match(/^(#+) (.*)/);
  if (heading) return heading[1].length === 1 ? html`<h2>${inline(heading[2])}</h2>` : html`<h3>${inline(heading[2])}</h3>`;
  const figure = words.match(/^!\[(.*?)\]\((.*?)\)$/);
  if (figure) return html`<p><${ServerPicture} path=${picture(figure[2])} alt=${figure[1] || figure[2]} /></p>`;
  if (words.startsWith("|")) return html`<${Table} rows=${words.split("\n")} />`;
  if (/^[-*] /.test(words)) return html`<ul>${words.split(/\n[-*] /).map(line => html`<li>${inline(line.replace(/^[-*] /, ""))}</li>`)}</ul>`;
  return html`<p>${inline(words)}</p>`;
}

function Table({ rows }) {
  const cells = row => row.replaceAll(/^\||\|$/g, "").split("|").map(cell => inline(cell.trim()));
  const [head, , ...body] = rows;
  return html`<div class="table" tabindex="0"><table><thead><tr>${cells(head).map(cell => html`<th scope="col">${cell}</th>`)}</tr></thead>
    <tbody>${body.map(row => html`<tr>${cells(row).map(cell => html`<td>${cell}</td>`)}</tr>`)}</tbody></table></div>`;
}

const inline = words => words.split(/(`[^`]*`|\*\*[^*]*\*\*)/).map(part => (part.startsWith("`") ? html`<code>${part.slice(1, -1)}</code>`
  : part.startsWith("**") ? html`<b>${part.slice(2, -2)}</b>` : part));
