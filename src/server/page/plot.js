// Charts by uPlot, in the colors of the page, as wide as their place.

import { html, useLayoutEffect, useRef } from "./preact.js";
import uPlot from "./uplot.js";

const color = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const COLORS = ["--blue", "--orange", "--green", "--violet", "--red", "--teal"];

const axis = (label, options = {}) => ({
  label, labelSize: label ? 18 : 0, size: 44, labelFont: "12px system-ui", font: "11px system-ui",
  stroke: () => color("--quiet"), grid: { stroke: () => color("--line"), width: 1 }, ticks: { stroke: () => color("--line"), width: 1 }, ...options,
});

// Losses reach far below 0.001. What is left out stays null.
const LOGARITHMIC = { size: 58, values: (_, ticks) => ticks.map(tick => (tick === null ? null : `${+tick.toPrecision(2)}`)) };

// A line across the chart at the place `x`.
function drawMark(chart, x) {
  if (x === undefined) return;
  const left = chart.valToPos(x, "x", true), { ctx: context, bbox: { top, height } } = chart;
  context.fillStyle = color("--ink");
  context.fillRect(left - 1, top, 2 * devicePixelRatio, height);
}

// series: [{ label, color, dash, width, points }]; data: the x values, then those of each series.
// `sync` names charts that share a cursor.
export function Plot({ label, data, series, height = 150, x = "", y = "", log, sync, bands, range, onPick, mark, legend = false }) {
  const place = useRef(), plot = useRef(), pick = useRef(), marked = useRef();
  pick.current = onPick;
  marked.current = mark;
  const kind = JSON.stringify([series, log, bands, sync, x, y]);
  useLayoutEffect(() => {
    const line = ({ label: name, color: shade, dash, width = 1.5, points = false }) => ({
      label: name, stroke: () => color(shade), dash, width, points: { show: points }, spanGaps: true,
    });
    const made = new uPlot({
      width: place.current.clientWidth || 300, height, legend: { show: legend, live: false },
      scales: { x: { time: false }, y: { distr: log ? 3 : 1, range } },
      axes: [axis(x, { size: 30 }), axis(y, log ? LOGARITHMIC : {})], series: [{ label: x || "x" }, ...series.map(line)],
      bands: bands?.map(pair => ({ series: pair, fill: () => `${color("--blue")}22` })),
      cursor: { sync: sync && { key: sync, setSeries: false }, drag: { x: false, y: false }, points: { size: 6 } },
      hooks: { draw: [chart => drawMark(chart, marked.current)] },
    }, data, place.current);
    plot.current = made;
    made.over.addEventListener("click", () => {
      const x = made.data[0][made.cursor.idx];
      if (x !== undefined) pick.current?.(x);
    });
    const resized = new ResizeObserver(() => made.setSize({ width: place.current.clientWidth, height }));
    resized.observe(place.current);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const redraw = () => made.redraw();
    dark.addEventListener("change", redraw);
    return () => {
      resized.disconnect();
      dark.removeEventListener("change", redraw);
      made.destroy();
    };
  }, [kind, height]);
  useLayoutEffect(() => plot.current.setData(data), [data]);
  // Its first drawing comes by itself.
  useLayoutEffect(() => { if (plot.current.status) plot.current.redraw(false); }, [mark]);
  return html`<div class=${`plot ${onPick ? "pickable" : ""}`} ref=${place} role="img" aria-label=${label} />`;
}
