// Pictures: canvases that keep the last image until the next one, so that none is ever empty or broken.

import { html, useLayoutEffect, useRef } from "./preact.js";
import { draw } from "./gray.js";

// `image`, or its difference to `other`. Without an image, the last one stays and is dimmed. `note` is shown over it.
export function Picture({ image, other, label, caption, note, dim, className = "" }) {
  const canvas = useRef();
  // Before the browser paints, so that all of a moment is painted at once.
  useLayoutEffect(() => {
    if (!image) return;
    draw(canvas.current, image, other);
  }, [image, other]);
  const shape = image ? { aspectRatio: `${image.width} / ${image.height}` } : {};
  return html`<figure class=${`picture ${className} ${dim || !image ? "dim" : ""} ${other ? "difference" : ""}`}>
    ${caption && html`<figcaption>${caption}</figcaption>`}
    <div class="frame"><canvas ref=${canvas} width="64" height="64" style=${shape} role="img" aria-label=${label} />
    ${note && html`<span class="note">${note}</span>`}</div>
  </figure>`;
}

// Two images on one another: mixed, or the first to the left of a line and the second to the right.
export function Mixed({ image, other, mode, at, caption, label }) {
  const [below, above] = [useRef(), useRef()];
  useLayoutEffect(() => {
    if (image) draw(below.current, image);
    if (other) draw(above.current, other);
  }, [image, other]);
  const shape = image ? { aspectRatio: `${image.width} / ${image.height}` } : {};
  const cut = mode === "wipe" ? { clipPath: `inset(0 0 0 ${at}%)` } : { opacity: at / 100 };
  return html`<figure class="picture mixed">
    <figcaption>${caption}</figcaption>
    <div class="frame">
      <canvas ref=${below} width="64" height="64" style=${shape} role="img" aria-label=${label} />
      <canvas ref=${above} class="above" width="64" height="64" style=${{ ...shape, ...cut }} aria-hidden="true" />
      ${mode === "wipe" && html`<span class="edge" style=${{ left: `${at}%` }} />`}
    </div>
  </figure>`;
}
