// Click a column's name to sort by the first number of its cells; click again to reverse.
for (const head of document.querySelectorAll("th")) {
  head.addEventListener("click", () => {
    const column = head.cellIndex, body = head.closest("table").tBodies[0];
    const down = head.getAttribute("aria-sort") === "ascending";
    const key = row => {
      const first = row.cells[column].firstChild;
      const text = first && first.nodeName !== "SMALL" ? first.textContent : "";  // not the paper's
      const number = parseFloat(text);
      return column === 0 ? text : Number.isNaN(number) ? -Infinity : number;
    };
    for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const order = (a, b) => (key(a) > key(b)) - (key(a) < key(b));
    [...body.rows].sort((a, b) => down ? order(b, a) : order(a, b)).forEach(row => body.append(row));
  });
}
const clouds = JSON.parse(document.getElementById("data").textContent);
if (clouds.length) {
  const run = document.getElementById("run"), shape = document.getElementById("shape");
  const trace = (name, points, colour, size, hidden) => ({
    type: "scatter3d", mode: "markers", name, marker: {size, color: colour},
    visible: hidden ? "legendonly" : true,
    x: points.map(p => p[0]), y: points.map(p => -p[2]), z: points.map(p => p[1]),
  });
  const draw = () => {
    const chosen = clouds[run.value];
    const traces = Object.entries(chosen.points).map(([name, points]) =>
      trace(name, points[shape.value], chosen.colours[name], name === "input" ? 1.5 : 4,
        chosen.hidden.includes(name)));
    const scene = {aspectmode: "data", xaxis: {visible: false}, yaxis: {visible: false}, zaxis: {visible: false}};
    const font = {color: getComputedStyle(document.body).color}, paper_bgcolor = "rgba(0, 0, 0, 0)";
    Plotly.react("view", traces,
      {scene, font, paper_bgcolor, margin: {l: 0, r: 0, t: 0, b: 0}, uirevision: "keep"},
      {displaylogo: false, responsive: true});
  };
  const fill = () => {
    shape.replaceChildren(...clouds[run.value].titles.map((title, i) => new Option(title, i)));
    draw();
  };
  clouds.forEach((cloud, i) => run.add(new Option(cloud.name, i)));
  run.addEventListener("change", fill);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  shape.addEventListener("change", draw);
  fill();
}
