// The address behind the #: a view with its parameters, as in #data?set=drive&episode=3&frame=20.

export function read(hash = location.hash) {
  const [view, query] = hash.slice(1).split("?");
  return { view, parameters: Object.fromEntries(new URLSearchParams(query)) };
}

export function link(view, parameters = {}) {
  const given = Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null && value !== "");
  return `#${view}${given.length ? `?${new URLSearchParams(given)}` : ""}`;
}

// Opens another view; the browser's back button returns.
export const go = (view, parameters) => { location.hash = link(view, parameters); };

// Notes parameters of the open view, without a new entry in the history.
export function note(changes) {
  const { view, parameters } = read();
  const address = link(view, { ...parameters, ...changes });
  if (address === location.hash) return;
  history.replaceState(null, "", address);
  dispatchEvent(new Event("noted"));
}
