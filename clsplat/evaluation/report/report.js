// Behaviour of a report: the wipe between two images, the choice of images, and sorting of the table.
// The handle of the wipe is a range input over the image, so that mouse, touch and keyboard work.
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
