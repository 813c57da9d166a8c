// What the server has: models, data sets and jobs. Its events say when to read a list again.

import { useEffect, useState } from "./preact.js";
import { ApiError, all, get, listen, onLocked } from "./api.js";
import { shared } from "./shared.js";

// connection: connecting, connected, reconnecting, stopping or locked. A list is null until it is known.
const { change, use: useLists } = shared({ connection: "connecting", locked: null, models: null, notice: null, datasets: null, jobs: null, may_use_jobs: true });
export { useLists };

// The best first: by the skill on test data; models without a score last.
const bySkill = (one, other) => (skillOf(other) ?? -9) - (skillOf(one) ?? -9) || one.name.localeCompare(other.name);
export const skillOf = model => model.metrics.test?.skill;
export const takesActions = model => model.spec.conditioning.endsWith("action");
export const takesState = model => model.spec.conditioning.startsWith("state");

// Such a model takes the state at every frame, and frames of any camera.
export const estimatesDepth = model => Boolean(model.spec.flow?.depth);

export async function readModels() {
  const { models, notice } = await all("/v1/models", "models");
  change({ models: models.sort(bySkill), notice: notice ?? null });
}

async function readJobs() {
  try {
    const [{ jobs }, { datasets }] = await Promise.all([get("/v1/jobs?limit=100"), all("/v1/datasets", "datasets")]);
    change({ jobs, datasets, may_use_jobs: true });
  } catch (error) {
    // A key for predictions only.
    if (!(error instanceof ApiError && error.status === 403)) throw error;
    change({ jobs: [], datasets: [], may_use_jobs: false });
  }
}

// How long the page says that the server stops, before it only says that it tries again.
const STOPPING_MS = 3000;

// A number that grows whenever the connection is back after something failed.
export function useRetry(has_failed) {
  const { connection } = useLists();
  const [count, setCount] = useState(0);
  useEffect(() => {
    if (connection === "connected" && has_failed) setCount(now => now + 1);
  }, [connection]);
  return count;
}

// A list that could not be read is read again after the next event; "lost" follows.
const quietly = work => work().catch(() => {});

let stop = () => {};
export function follow() {
  stop();
  // The first list need not wait for the events.
  quietly(readModels);
  let stopping_ms = -Infinity;
  stop = listen("/v1/events", name => {
    if (name === "open") change({ connection: "connected", locked: null });
    else if (name === "lost") {
      if (performance.now() - stopping_ms > STOPPING_MS) change({ connection: "reconnecting" });
    } else if (name === "stopping") {
      stopping_ms = performance.now();
      change({ connection: "stopping" });
    }
    else if (name === "models") quietly(readModels);
    else if (name === "jobs") quietly(readJobs);
  });
}

onLocked(why => {
  stop();
  change({ connection: "locked", locked: why });
});
