"use strict";
(function () {
document.querySelectorAll("table.sortable thead th").forEach((head) => {
  head.onclick = () => {
    const body = head.closest("table").tBodies[0], down = head.dataset.down !== "1";
    head.dataset.down = down ? "1" : "0";
    const value = (row) => {
      const cell = row.cells[head.cellIndex];
      return cell.dataset.value === undefined ? cell.textContent : parseFloat(cell.dataset.value || "-Infinity");
    };
    const order = (a, b) => (typeof a === "string" ? a.localeCompare(b) : b - a) * (down ? 1 : -1);
    body.append(...[...body.rows].sort((a, b) => order(value(a), value(b))));
  };
});
window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
})();
