// A stream of a model over a WebSocket: frames go in, predicted frames come out. See /asyncapi.yaml.

import { call, deleteAtEnd, keyProtocols } from "./api.js";
import { toBytes } from "./base64.js";
import { Gray, raw } from "./gray.js";
import { estimatesDepth } from "./server_lists.js";

export class Stream {
  // Resolves when the server is ready for the first frame. Another camera than the model's needs a session, and a model with a
  // use for it.
  static async open(model, camera) {
    const { name } = model;
    if (!camera || !estimatesDepth(model)) return Stream.connect(`/v1/models/${name}/stream`);
    const { id, token } = await call("POST", "/v1/sessions", { model: name, camera });
    return Object.assign(await Stream.connect(`/v1/sessions/${id}/stream?token=${token}`), { session: `/v1/sessions/${id}?token=${token}` });
  }

  static connect(path) {
    return new Promise((opened, failed) => {
      const scheme = location.protocol === "https:" ? "wss" : "ws";
      const stream = new Stream(new WebSocket(`${scheme}://${location.host}${path}`, ["foreframe.v1.json", ...keyProtocols()]));
      stream.waiting.set("ready", { resolve: ready => opened(Object.assign(stream, { ready })), reject: failed });
    });
  }

  constructor(socket) {
    this.socket = socket;
    this.seq = 0;
    // Those who wait for an answer, by its seq; in the order of their frames.
    this.waiting = new Map();
    socket.onmessage = ({ data }) => this.receive(JSON.parse(data));
    socket.onclose = () => this.fail("the stream is closed");
  }

  receive(message) {
    if (message.type === "closing") return this.fail(`the stream was closed: ${message.reason}`);
    if (message.type === "warning") return;
    // An error answers the oldest frame.
    const place = message.type === "ready" ? "ready" : message.seq ?? this.waiting.keys().next().value;
    const waiting = this.waiting.get(place);
    this.waiting.delete(place);
    if (message.type === "error") waiting?.reject(new Error(message.detail));
    else waiting?.resolve(message);
  }

  fail(reason) {
    for (const { reject } of this.waiting.values()) reject(new Error(reason));
    this.waiting.clear();
    this.socket.close();
  }

  // Sends a frame with what the model takes besides. Resolves to the answer, its frames decoded.
  async send({ frame, action, state, plan, steps }) {
    const { conditioning } = this.ready.spec;
    const message = { type: "frame", seq: this.seq++, timestamp_us: Math.round(performance.now() * 1000), format: "raw", steps };
    if (conditioning.endsWith("action")) Object.assign(message, { action, plan });
    if (conditioning.startsWith("state")) message.state = state;
    if (this.socket.readyState !== WebSocket.OPEN) throw new Error("the stream is closed");
    const answer = await new Promise((resolve, reject) => {
      this.waiting.set(message.seq, { resolve, reject });
      this.socket.send(JSON.stringify({ ...message, image: raw(frame) }));
    });
    const decode = text => new Gray(frame.width, frame.height, toBytes(text));
    return { ...answer, frames: answer.frames?.map(decode) };
  }

  close() {
    this.socket.onclose = null;
    this.fail("closed");
    if (this.session) deleteAtEnd(this.session);
  }
}

// Sends a context and returns the answer to its last frame.
export async function sendAll(stream, moments) {
  let answer = null;
  for (const moment of moments) answer = await stream.send(moment);
  return answer;
}
