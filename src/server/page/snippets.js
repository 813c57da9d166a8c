// The same by curl or Python: what a view does, as text to copy.

import { html, useState } from "./preact.js";
import { hasKey } from "./api.js";

const header = () => (hasKey() ? " -H 'Authorization: Bearer KEY'" : "");
const quoted = body => `'${JSON.stringify(body).replaceAll("'", "'\\''")}'`;

export function curl(method, path, body, options = "") {
  const data = body === undefined ? "" : ` \\\n  -H 'Content-Type: application/json' -d ${quoted(body)}`;
  return `curl -s${method === "GET" || body !== undefined ? "" : ` -X ${method}`} ${location.origin}${path}${header()}${options}${data}`;
}

// JSON's literals in Python; a string that contains one stays.
const LITERALS = { true: "True", false: "False", null: "None" };
const python = value => JSON.stringify(value).replaceAll(/"(?:[^"\\]|\\.)*"|true|false|null/g, part => LITERALS[part] ?? part);

export function requests(method, path, body, rest = "print(answer.json())") {
  const given = [hasKey() && 'headers={"Authorization": "Bearer KEY"}', body !== undefined && `json=${python(body)}`].filter(Boolean);
  return `import requests\n\nanswer = requests.${method.toLowerCase()}("${location.origin}${path}"${given.map(one => `, ${one}`).join("")})\n${rest}`;
}

// A stream needs a program: this one drives the simulator and predicts from its frames.
export function streamInPython(model, scenario, is_varied) {
  const headers = hasKey() ? ', additional_headers={"Authorization": "Bearer KEY"}' : "";
  const given = hasKey() ? ', headers={"Authorization": "Bearer KEY"}' : "";
  const world = is_varied ? ', "world": {"rooms": "varied"}' : "";
  // Each of these rooms has a camera of its own, which only a session can be told.
  const address = is_varied ? `camera = robot["info"]["trial"]["room"]["camera"]
del camera["noise_std"]
session = requests.post(f"{server}/v1/sessions", json={"model": "${model}", "camera": camera}${given}).json()
address = server.replace("http", "ws", 1) + f"/v1/sessions/{session['id']}/stream?token={session['token']}"` : `address = server.replace("http", "ws", 1) + "/v1/models/${model}/stream"`;
  return `import json, requests
from websockets.sync.client import connect

server = "${location.origin}"
robot = requests.post(f"{server}/v1/environments", json={"scenario": "${scenario}"${world}}${given}).json()
${address}
with connect(address, subprotocols=["foreframe.v1.json"]${headers}) as stream:
    print(json.loads(stream.recv())["type"])  # ready
    for seq in range(20):
        action, seen = robot["info"]["policy_action"], robot["observation"]
        stream.send(json.dumps({"type": "frame", "seq": seq, "timestamp_us": seq * 200_000,
                                "image": seen["frame"], "action": action, "state": seen["state"]}))
        answer = json.loads(stream.recv())
        print(answer["type"], len(answer.get("frames", [])), "frames predicted")
        path = f"{server}/v1/environments/{robot['id']}" if "id" in robot else path
        robot = requests.post(f"{path}/step", json={"action": action}${given}).json()`;
}

// Two buttons that copy.
export function Copy({ curl: command, python: program }) {
  const [copied, setCopied] = useState("");
  const copy = (name, text) => async () => {
    await navigator.clipboard.writeText(text()).catch(() => copyBySelection(text()));
    setCopied(name);
    setTimeout(() => setCopied(""), 1500);
  };
  const button = (name, text) => html`<button class="small" onClick=${copy(name, text)}>${copied === name ? "copied" : `copy as ${name}`}</button>`;
  return html`<span class="copy">${command && button("curl", command)}${program && button("Python", program)}</span>`;
}

// Browsers offer the clipboard to secure pages only.
function copyBySelection(text) {
  const area = Object.assign(document.createElement("textarea"), { value: text });
  document.body.append(area);
  area.select();
  document.execCommand("copy");
  area.remove();
}
