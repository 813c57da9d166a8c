// The form of an import: of a path on the server, or of a file that is dropped or chosen here, which is uploaded first.

import { html, useRef, useState } from "./preact.js";
import { upload } from "./api.js";

const ENDINGS = /\.(zip|tar|tar\.gz|tgz|mcap|db3|npy|npz|mp4|mkv|avi|mov|webm)$/i;

// The fields of a form that are not empty.
export const filled = form => Object.fromEntries([...new FormData(form)].filter(([, value]) => value !== ""));
const list = words => words?.split(/[\s,]+/).filter(Boolean);

// The name as the server takes it, and the data set's name that fits.
const plain = name => name.replaceAll(/[^A-Za-z0-9._ ()+-]/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(-110);
const datasetName = name => name.replace(ENDINGS, "").toLowerCase().replaceAll(/[^a-z0-9]+/g, "-").replaceAll(/^-+|-+$/g, "").slice(0, 64) || "recording";

// `submit` gets the job and resolves to whether the server took it.
export function Import({ submit }) {
  const form = useRef(), running = useRef(null);
  const [source, setSource] = useState("");
  const [name, setName] = useState("");
  const [share, setShare] = useState(null);
  const [wrong, setWrong] = useState("");
  const [is_over, setOver] = useState(false);
  const send = async changed => {
    const { size, rate, action, state, ...fields } = { ...filled(form.current), ...changed };
    const spec = { kind: "import", ...fields, size, ...(rate && { rate: +rate }), ...(action && { action: list(action) }), ...(state && { state: list(state) }) };
    // The server deletes an upload with its import.
    if (await submit(spec) && fields.source.startsWith("upload:")) setSource("");
  };
  const take = async files => {
    const [file] = files;
    if (!file || running.current) return;
    if (files.length > 1 || !ENDINGS.test(file.name)) {
      setWrong("Drop one file: an archive (.zip, .tar, .tar.gz) of a folder, a bag (.mcap, .db3), an array (.npy, .npz) or a video.");
      return;
    }
    const chosen = name || datasetName(file.name);
    setName(chosen);
    setWrong("");
    setShare(0);
    running.current = upload(`/v1/uploads?name=${encodeURIComponent(plain(file.name))}`, file, setShare);
    try {
      const received = await running.current.done;
      setSource(received.source);
      await send({ name: chosen, source: received.source });
    } catch (error) {
      setWrong(error.message);
    }
    running.current = null;
    setShare(null);
  };
  const over = is_now => event => {
    event.preventDefault();
    setOver(is_now);
  };
  return html`<form class=${`card drop ${is_over ? "over" : ""}`} ref=${form} onSubmit=${event => { event.preventDefault(); send({}); }}
      onDragOver=${over(true)} onDragLeave=${over(false)} onDrop=${event => { over(false)(event); take(event.dataTransfer.files); }}>
    <h3>Import a recording</h3>
    <div class="form">
    <label>Name <input name="name" required pattern="[a-z0-9][a-z0-9\\-]*" placeholder="mycar" value=${name} onInput=${event => setName(event.target.value)} /></label>
    <label>Path in the import folder, or upload <input name="source" required placeholder="drive-1" value=${source} onInput=${event => setSource(event.target.value)} /></label>
    <label>Size <input name="size" value="64x64" pattern="[0-9]{1,4}x[0-9]{1,4}" /></label>
    <label>Frames per second <input name="rate" type="number" step="any" min="0.01" placeholder="as recorded" /></label>
    <label>Actions <input name="action" placeholder="found by name" /></label>
    <label>States <input name="state" placeholder="found by name" /></label>
    </div><div class="actions"><button class="main">Import</button></div>
    <p class="files"><label>Or drop a file here, or choose one: it is imported with these settings <input type="file" onChange=${event => { take(event.target.files); event.target.value = ""; }} /></label></p>
    ${share !== null && html`<div class="sending"><progress aria-label="progress of the upload" max="1" value=${share} /><span class="quiet">${share < 1 ? `uploaded ${(100 * share).toFixed(0)} %` : "the import begins…"}</span>
      <button type="button" class="small" onClick=${() => running.current?.stop()}>Stop</button></div>`}
    <p class="wrong" role="alert">${wrong}</p></form>`;
}
