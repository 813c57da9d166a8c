// The form of an import: of a path on the server, or of a file that is dropped or chosen here, which is uploaded first.

import { html, useEffect, useState } from "./preact.js";
import { call, upload } from "./api.js";
import { shared } from "./shared.js";

const ENDINGS = /\.(zip|tar|tar\.gz|tgz|mcap|db3|npy|npz|mp4|mkv|avi|mov|webm)$/i;

// The fields of a form that are not empty.
export const filled = form => Object.fromEntries([...new FormData(form)].filter(([, value]) => value !== ""));
const list = words => words.split(/[\s,]+/).filter(Boolean);

// The name as the server takes it, and the data set's name that fits.
const plain = name => name.replaceAll(/[^A-Za-z0-9._ ()+-]/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(-110);
const datasetName = name => name.replace(ENDINGS, "").toLowerCase().replaceAll(/[^a-z0-9]+/g, "-").replaceAll(/^-+|-+$/g, "").slice(0, 64) || "recording";

// The form as it is filled in, its upload and its job. It is kept outside of the component, so that an upload goes on while another view
// is open. `share` is how much of the file was sent; null without an upload.
const EMPTY = { name: "", source: "", size: "64x64", rate: "", every: "", action: "", state: "", fov: "", tilt: "", camera_height: "", skip_bad: false };
const { now, change, use: useForm } = shared({ fields: EMPTY, share: null, stop: null, job_id: null, wrong: "" });
const fill = changes => change({ fields: { ...now().fields, ...changes } });

const NUMBERS = ["rate", "every", "fov", "tilt", "camera_height"];

async function submit({ name, source, size, action, state, skip_bad, ...fields }) {
  const numbers = Object.fromEntries(NUMBERS.filter(field => fields[field] !== "").map(field => [field, +fields[field]]));
  const spec = { kind: "import", name, source, ...(size && { size }), ...numbers, ...(action && { action: list(action) }), ...(state && { state: list(state) }), ...(skip_bad && { skip_bad }) };
  try {
    const { id } = await call("POST", "/v1/jobs", spec);
    change({ job_id: id, wrong: "" });
  } catch (error) {
    change({ wrong: error.message });
  }
}

async function take(files) {
  const [file] = files;
  if (!file || now().stop) return;
  if (files.length > 1 || !ENDINGS.test(file.name)) {
    change({ wrong: "Drop one file: an archive (.zip, .tar, .tar.gz) of a folder, a bag (.mcap, .db3), an array (.npy, .npz) or a video." });
    return;
  }
  const { done, stop } = upload(`/v1/uploads?name=${encodeURIComponent(plain(file.name))}`, file, share => change({ share }));
  change({ stop, share: 0, wrong: "" });
  fill({ name: now().fields.name || datasetName(file.name) });
  try {
    const { source } = await done;
    // Other fields may have been changed meanwhile.
    fill({ source, name: now().fields.name || datasetName(file.name) });
    await submit(now().fields);
  } catch (error) {
    change({ wrong: error.message });
  }
  change({ stop: null, share: null });
}

// After a success, name and source are emptied for the next import; a failed one can be corrected and submitted again. The server deletes
// an upload that was imported.
function useEmptied(jobs) {
  useEffect(() => {
    const job = jobs.find(({ id }) => id === now().job_id);
    if (job?.state !== "succeeded") return;
    change({ job_id: null });
    for (const field of ["name", "source"]) if (now().fields[field] === job.spec[field]) fill({ [field]: "" });
  }, [jobs]);
}

export function Import({ jobs }) {
  const { fields, share, stop, wrong } = useForm();
  const [is_over, setOver] = useState(false);
  useEmptied(jobs);
  const over = is_now => event => {
    event.preventDefault();
    setOver(is_now);
  };
  const field = name => ({ name, value: fields[name], onInput: event => fill({ [name]: event.target.value }) });
  return html`<form class=${`card drop ${is_over ? "over" : ""}`} onSubmit=${event => { event.preventDefault(); submit(fields); }}
      onDragOver=${over(true)} onDragLeave=${over(false)} onDrop=${event => { over(false)(event); take(event.dataTransfer.files); }}>
    <h3>Import a recording</h3>
    <div class="form">
    <label>Name <input ...${field("name")} required pattern="[a-z0-9][a-z0-9\\-]*" placeholder="mycar" /></label>
    <label>Path in the import folder, or upload <input ...${field("source")} required placeholder="drive-1" /></label>
    <label>Size <input ...${field("size")} pattern="[0-9]{1,4}x[0-9]{1,4}" /></label>
    <label>Frames per second <input ...${field("rate")} type="number" step="any" min="0.01" placeholder="as recorded" /></label>
    <label>Keep every Nth frame <input ...${field("every")} type="number" min="1" placeholder="1: all" /></label>
    <label>Actions <input ...${field("action")} placeholder="found by name" /></label>
    <label>States <input ...${field("state")} placeholder="found by name" /></label>
    </div><p class="quiet">Actions are what the robot was told, states what it measured. Columns of a table are found if their names begin with <code>action</code> or <code>state</code>; write the names of others here, or <code>none</code>.</p>
    <details><summary>Camera and damage</summary><div class="form">
    <label>Field of view, left to right, in degrees <input ...${field("fov")} type="number" step="any" placeholder="unknown" /></label>
    <label>Looks down by, in degrees <input ...${field("tilt")} type="number" step="any" placeholder="0" /></label>
    <label>Height above the floor, in metres <input ...${field("camera_height")} type="number" step="any" placeholder="unknown" /></label>
    <fieldset class="wide"><legend>Damaged images and lines</legend><label><input type="checkbox" checked=${fields.skip_bad} onChange=${() => fill({ skip_bad: !fields.skip_bad })} /> leave them out and list them, instead of stopping there</label></fieldset>
    </div></details>
    <div class="actions"><button class="main">Import</button></div>
    <p class="files"><label>Or drop a file here, or choose one: it is imported with these settings <input type="file" onChange=${event => { take(event.target.files); event.target.value = ""; }} /></label></p>
    ${stop && html`<div class="sending"><progress aria-label="progress of the upload" max="1" value=${share} /><span class="quiet">${share < 1 ? `uploaded ${(100 * share).toFixed(0)} %` : "the import begins…"}</span>
      <button type="button" class="small" onClick=${stop}>Stop</button></div>`}
    <p class="wrong" role="alert">${wrong}</p></form>`;
}
