// Predictions over HTTP from a context of moments, with a plan.

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
