"use strict";
// The page is complete without this: it adds sorting, filtering, zoom on click, and opens what a link leads to.
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  document.documentElement.className = "js";
  const shown = cell => cell.dataset.value ?? cell.textContent.trim();

  function sort(header, table) {
    const column = header.cellIndex, down = header.getAttribute("aria-sort") === "ascending";
    const body = table.tBodies[0], number = text => (text === "" ? NaN : Number(text));
    const rows = [...body.rows].map(row => [shown(row.cells[column]), row]);
    rows.sort(([a], [b]) => {
      const x = number(a), y = number(b);
      if (isNaN(x) || isNaN(y)) return isNaN(x) && isNaN(y) ? (down ? -1 : 1) * a.localeCompare(b) : isNaN(x) - isNaN(y);
      return (down ? -1 : 1) * (x - y);
    });
    body.append(...rows.map(([, row]) => row));
    all("th[aria-sort]", table).forEach(other => other.removeAttribute("aria-sort"));
    header.setAttribute("aria-sort", down ? "descending" : "ascending");
  }

  for (const table of all("table.sortable")) {
    for (const header of table.tHead.rows[table.tHead.rows.length - 1].cells) {
      const button = document.createElement("button");
      button.append(...header.childNodes);
      button.setAttribute("aria-label", header.dataset.label);
      header.append(button);
      button.onclick = () => sort(header, table);
    }
    const label = document.createElement("label"), field = document.createElement("input"), count = document.createElement("output");
    field.type = "search";
    label.className = "filter";
    label.append("Show rows with ", field, " ", count);
    field.oninput = () => {
      const words = field.value.toLowerCase().split(/\s+/);
      const rows = [...table.tBodies[0].rows];
      rows.forEach(row => { row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word)); });
      count.textContent = field.value && `${rows.filter(row => !row.hidden).length} of ${rows.length}`;
    };
    table.parentElement.before(label);
  }

  function open() {
    let target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!target) return;
    const inner = target.matches("section") && target.querySelector(":scope > details");
    if (inner) inner.open = true;
    for (let at = target; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
    target.scrollIntoView();
  }
  addEventListener("hashchange", open);
  open();

  for (const picture of all("figure svg")) {
    picture.parentElement.onclick = () => picture.classList.toggle("zoomed");
  }

  if (window.IntersectionObserver) {
    const links = new Map(all("nav a").map(link => [link.hash.slice(1), link]));
    const watch = new IntersectionObserver(seen => seen.forEach(({ target, isIntersecting }) => {
      if (!isIntersecting) return;
      links.forEach(link => link.removeAttribute("aria-current"));
      links.get(target.id)?.setAttribute("aria-current", "true");
    }), { rootMargin: "-10% 0px -80% 0px" });
    all("main section[id]").forEach(section => watch.observe(section));
  }
})();
