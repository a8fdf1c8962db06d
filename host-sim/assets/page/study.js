// A study: error against broadcasts of every cell.

// Round numbers within a range, at least three if possible: powers of ten, or multiples of them.
function logarithmicTicks(low, high) {
  const multiples = [[1], [1, 2, 5], [1, 2, 3, 4, 5, 6, 7, 8, 9], Array.from({ length: 90 }, (_, k) => 1 + k / 10)];
  const between = (steps) => {
    const ticks = [];
    for (let decade = Math.floor(Math.log10(low)); decade <= Math.log10(high); decade++) {
      ticks.push(...steps.map((step) => Number((step * 10 ** decade).toPrecision(3))));
    }
    return ticks.filter((tick) => tick >= low && tick <= high);
  };
  const ticks = multiples.map(between).find((found) => found.length > 2) ?? between(multiples.at(-1));
  const stride = Math.ceil(ticks.length / 9);
  return ticks.filter((_, index) => index % stride === 0);
}

function tradeoffPlot(data) {
  const all = data.lines.flatMap((line) => line.points.map((point) => ({ ...point, line })));
  const points = all.filter((point) => point.broadcasts[1] > 0 && point.error[1] > 0);
  const missing = all.length - points.length;
  if (!points.length) return element("p", {}, "No cell has a result with broadcasts, so there is nothing to draw.");
  const frame = element("div", { class: "frame", tabindex: 0, role: "group",
    "aria-label": `${data.error_label} against broadcasts, one mark for each cell; the table below has the numbers. Drag to zoom, double click to show all.` });
  const status = element("p", { class: "note", role: "status" }, "Bars reach from the 2.5th to the 97.5th percentile of the runs. Point at a mark for its numbers; drag to zoom, double click to show all.");
  const legend = element("ul", { class: "legend" });
  const extent = (values) => {
    const positive = values.filter((value) => value > 0);
    return [Math.min(...positive) / 1.3, Math.max(...positive) * 1.3];
  };
  const [xs, ys] = [extent(points.flatMap((point) => point.broadcasts)), extent(points.flatMap((point) => point.error))];
  let plot;
  let [shownX, shownY] = [xs, ys];
  const show = (x, y) => {
    [shownX, shownY] = [x, y];
    plot.setScale("x", { min: x[0], max: x[1] });
    plot.setScale("y", { min: y[0], max: y[1] });
  };
  const selected = () => {
    const { left, top, width, height } = plot.select;
    if (width < 5 || height < 5) return;
    const x = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    const y = [plot.posToVal(top + height, "y"), plot.posToVal(top, "y")];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    show(x, y);
  };
  // The end of a bar at zero is at the border.
  const at = (value, axis) => plot.valToPos(value > 0 ? value : (axis === "x" ? xs : ys)[0], axis, true);
  const place = (point, index = 1) => [plot.valToPos(point.broadcasts[index], "x", true), plot.valToPos(point.error[index], "y", true)];
  const draw = () => {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    data.lines.forEach((line, index) => {
      const own = points.filter((point) => point.line === line);
      ctx.strokeStyle = ctx.fillStyle = agentColour(index);
      ctx.lineWidth = 1.5 * devicePixelRatio;
      if (line.is_joined) {
        ctx.beginPath();
        own.forEach((point) => ctx.lineTo(...place(point)));
        ctx.stroke();
      }
      ctx.lineWidth = devicePixelRatio;
      for (const point of own) {
        const [x, y] = place(point);
        ctx.beginPath();
        ctx.moveTo(x, at(point.error[0], "y"));
        ctx.lineTo(x, at(point.error[2], "y"));
        ctx.moveTo(at(point.broadcasts[0], "x"), y);
        ctx.lineTo(at(point.broadcasts[2], "x"), y);
        ctx.stroke();
        ctx.beginPath();
        ctx.arc(x, y, 4 * devicePixelRatio, 0, 2 * Math.PI);
        ctx.fill();
      }
    });
    ctx.restore();
  };
  const nearest = () => {
    const { left, top } = plot.cursor;
    if (left == null || left < 0) return;
    const distance = (point) => Math.hypot(plot.valToPos(point.broadcasts[1], "x") - left, plot.valToPos(point.error[1], "y") - top);
    const found = points.reduce((best, point) => (distance(point) < distance(best) ? point : best));
    if (distance(found) > 25) return;
    const name = [found.line.name, found.label && `${data.along} = ${found.label}`].filter(Boolean).join(", ");
    const text = ([low, middle, high]) => `${number(middle)} (${number(low)} to ${number(high)})`;
    status.textContent = `${name ? `${name}: ` : ""}${data.error_label}: ${text(found.error)}; broadcasts ${text(found.broadcasts)}`;
  };
  const build = () => {
    if (plot) plot.destroy();
    const [text, grid] = [themeColour("faint"), themeColour("grid")];
    const axis = {
      stroke: text, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 },
      splits: (_, __, low, high) => logarithmicTicks(low, high),
      filter: (_, ticks) => ticks,
      values: (_, ticks) => ticks.map((tick) => number(tick, 3)),
    };
    plot = new uPlot({
      width: Math.max(50, Math.floor(frame.clientWidth)), height: 420, legend: { show: false },
      cursor: { drag: { x: true, y: true, setScale: false }, points: { show: false } },
      scales: { x: { time: false, distr: 3, range: () => shownX }, y: { distr: 3, range: () => shownY } },
      axes: [{ ...axis, label: "broadcasts of all agents", labelSize: 20 }, { ...axis, label: data.error_label, labelSize: 20, size: 62 }],
      series: [{}, { stroke: "transparent", points: { show: false } }],
      hooks: { draw: [draw], setCursor: [nearest], setSelect: [selected] },
    }, [xs, ys], frame);
    frame.querySelector("canvas").setAttribute("aria-hidden", "true");
    legend.replaceChildren(...data.lines.filter((line) => line.name).map((line, index) => {
      const mark = element("span", { class: "mark" });
      mark.style.borderColor = agentColour(index);
      return element("li", {}, mark, line.name);
    }));
  };
  frame.addEventListener("dblclick", () => show(xs, ys));
  new ResizeObserver(() => {
    const width = Math.floor(frame.clientWidth);
    if (width < 50) return;
    if (!plot) build();
    else if (plot.width !== width) plot.setSize({ width, height: 420 });
  }).observe(frame);
  darkGround.addEventListener("change", build);
  const note = missing ? element("p", { class: "note" }, `${counted(missing, "cell")} without broadcasts or errors cannot be drawn on these axes.`) : null;
  return element("div", { class: "plot" }, frame, legend, status, ...(note ? [note] : []));
}

function cellTable(data) {
  const interval = (name) => ({
    value: (cell) => cell[name]?.median,
    show: (_, cell) => (cell[name] ? `${number(cell[name].median)} (${number(cell[name].low, 3)} – ${number(cell[name].high, 3)})` : "–"),
  });
  const keys = data.keys.map((key, index) => ({ name: key, value: (cell) => cell.values[index], isText: index === 0 }));
  const columns = [
    ...keys,
    { name: "runs", value: (cell) => cell.runs },
    { name: "diverged", value: (cell) => cell.diverged },
    ...[["RMSE", "rmse"], ["largest error", "max_error"], ["innovation RMS", "innovation_rms"]]
      .filter(([, key]) => data.cells.some((cell) => cell[key]))
      .map(([name, key]) => ({ name, ...interval(key) })),
    { name: "broadcasts", ...interval("broadcasts") },
    { name: "bytes", ...interval("bytes") },
  ];
  return table("Median (2.5th to 97.5th percentile) of the runs of each cell: the largest error or innovation of an agent, and the broadcasts of all", columns, data.cells);
}
