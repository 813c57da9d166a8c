// State that is kept outside of the components: all of them see the same, also those of another view.

import { useEffect, useState } from "./preact.js";

// `now()` is the state; `change` replaces some of its fields; a component reads it by `use()`, and is drawn again after each change.
export function shared(state) {
  const listeners = new Set();
  const change = changes => {
    state = { ...state, ...changes };
    for (const listener of listeners) listener(state);
  };
  const use = () => {
    const [known, setKnown] = useState(state);
    useEffect(() => {
      listeners.add(setKnown);
      setKnown(state);
      return () => listeners.delete(setKnown);
    }, []);
    return known;
  };
  return { now: () => state, change, use };
}
