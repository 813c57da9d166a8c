// Base64 and bytes.

export const toBytes = text => Uint8Array.from(atob(text), character => character.charCodeAt(0));

export function fromBytes(bytes) {
  let text = "";
  // Few enough at once to be arguments of a call.
  for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  return btoa(text);
}
