// Predictions over HTTP from a context of moments, with a plan.

import { call } from "./api.js";
import { toBytes } from "./base64.js";
import { Gray, raw } from "./gray.js";
import { estimatesDepth, takesActions, takesState } from "./server_lists.js";

// The body of a request: the frames of the context, and the state if the model takes it: at the last frame, or at each one with the
// camera if the model estimates depth.
export function contextBody(model, context) {
  const camera = context.at(-1)?.camera;
  const known = !takesState(model) ? {}
    : estimatesDepth(model) ? { states: context.map(({ state }) => state), ...(camera && { camera }) }
    : { state: context.at(-1)?.state };
  return { frames: context.map(({ frame }) => raw(frame)), format: "raw", ...known };
}

export const decode = (frames, { frame_width_px, frame_height_px }) => frames.map(frame => new Gray(frame_width_px, frame_height_px, toBytes(frame)));

// The last frame that the model predicts from the context if these actions follow, and its errors to expect.
export async function predictLast(model, context, plan) {
  const body = { ...contextBody(model, context), ...(takesActions(model) && { plan }) };
  const answer = await call("POST", `/v1/models/${model.name}/predict`, body);
  return { ...answer, frames: decode(answer.frames.slice(-1), model.spec) };
}
