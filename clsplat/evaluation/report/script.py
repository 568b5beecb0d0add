"""Looks and behaviour of a page of measurements: sorting its table, and wiping between two images."""

STYLE = """
h3 { font-size: 1rem; margin: 1.6rem 0 .3rem; overflow-wrap: anywhere; } h3 small { font-weight: normal; }
th button { font: inherit; color: inherit; background: none; border: 0; padding: 0; cursor: pointer; }
th button::after { content: " \\2195"; opacity: .65; }
th[aria-sort=ascending] button::after { content: " \\2191"; opacity: 1; }
th[aria-sort=descending] button::after { content: " \\2193"; opacity: 1; }
td.best { font-weight: 600; }
.images { display: grid; gap: .8rem; grid-template-columns: repeat(auto-fit, minmax(min(19rem, 100%), 1fr)); }
.images figure { margin: 0; padding: 0; border: 0; background: none; min-width: 0;
                 max-width: calc(80vh * var(--shape)); }
.wipe { position: relative; overflow: hidden; border-radius: 4px; --at: 50%; }
.wipe img, .map img { display: block; width: 100%; height: auto; }
.wipe img { position: absolute; inset: 0; height: 100%; display: none; }
.wipe .under, .wipe .over { display: block; }
.wipe .over { z-index: 1; clip-path: inset(0 calc(100% - var(--at)) 0 0); }
.wipe .both { clip-path: none; }
.wipe::after { content: ""; position: absolute; z-index: 2; inset: 0 auto 0 calc(var(--at) - 1.5px); width: 3px;
               background: #fff; box-shadow: 0 0 0 1px #000a; pointer-events: none; }
.wipe input { position: absolute; z-index: 3; inset: 0; width: 100%; height: 100%; margin: 0; padding: 0;
              -webkit-appearance: none; appearance: none; background: none; cursor: ew-resize; touch-action: pan-y; }
.wipe input::-webkit-slider-runnable-track { height: 100%; background: none; }
.wipe input::-webkit-slider-thumb { -webkit-appearance: none; width: 3px; height: 100%; background: none; }
.wipe input::-moz-range-track { height: 100%; background: none; }
.wipe input::-moz-range-thumb { width: 3px; height: 100%; background: none; border: 0; }
.wipe input:focus-visible { outline: 3px solid #e69f00; outline-offset: -3px; }
.map { border-radius: 4px; overflow: hidden; }
.sides { display: flex; justify-content: space-between; gap: .5rem; }
figcaption { font-size: .85rem; margin-top: .25rem; overflow-wrap: anywhere; }
figcaption select { font: inherit; max-width: 45%; }
.bar { height: .6rem; border-radius: 2px; margin-top: .25rem; }
.histogram text { font-size: 12px; fill: #262626; } .histogram .grid { stroke: #e0e0e0; }
.histogram figcaption { color: #262626; } .histogram span { margin-right: 1rem; white-space: nowrap; }
.histogram i { display: inline-block; width: .8rem; height: .8rem; margin-right: .35rem; vertical-align: -.05rem; }
tbody th { font-weight: normal; } td.text { white-space: normal; overflow-wrap: anywhere; }
"""

# The wipe's handle is a range input over the image: mouse, touch and keyboard come with it.
SCRIPT = """
"use strict";
for (const wipe of document.querySelectorAll(".wipe")) {
  const slider = wipe.querySelector("input");
  slider.addEventListener("input", () => wipe.style.setProperty("--at", slider.value + "%"));
}
for (const choice of document.querySelectorAll("figcaption select")) {
  choice.addEventListener("change", () => {
    const figure = choice.closest("figure");
    const [left, right] = [...figure.querySelectorAll("select")].map((one) => one.value);
    for (const image of figure.querySelectorAll(".wipe img")) {
      image.classList.toggle("over", image.dataset.key === left);
      image.classList.toggle("under", image.dataset.key === right);
      image.classList.toggle("both", left === right);
    }
  });
}
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const rising = head.getAttribute("aria-sort") !== "ascending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", rising ? "ascending" : "descending");
    const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    const order = (a, b) => column ? key(a) - key(b) : key(a).localeCompare(key(b), undefined, {numeric: true});
    const rows = [...table.tBodies[0].rows].sort((a, b) => (rising ? 1 : -1) * order(a, b));
    table.tBodies[0].append(...rows);
  }));
}
"""
