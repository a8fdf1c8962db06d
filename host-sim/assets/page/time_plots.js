// Plots over time that share one range of time.

class TimePlots {
  // end, evaluation and markers are times. [s]
  constructor(end, evaluation, markers) {
    this.name = `range-${TimePlots.count += 1}`;
    this.end = end;
    this.evaluation = evaluation;
    this.markers = markers;
    this.from = 0;
    this.to = end;
    this.plots = [];
    this.listeners = [];
    this.fromField = element("input", { type: "number", min: 0, max: end, step: "any" });
    this.toField = element("input", { type: "number", min: 0, max: end, step: "any" });
    for (const field of [this.fromField, this.toField]) {
      field.addEventListener("change", () => this.setRange(Number(this.fromField.value), Number(this.toField.value)));
    }
    // A word is its own name; a sign needs one.
    const button = (text, label, act) => element("button", {
      type: "button", "aria-label": /^[A-Z]/.test(text) ? null : label, title: label, onclick: act }, text);
    this.tools = element("div", { class: "tools sticky", role: "group", "aria-label": "Range of time of all plots" },
      element("label", {}, "from [s]", this.fromField),
      element("label", {}, "to [s]", this.toField),
      button("+", "Zoom in", () => this.zoom(0.5)),
      button("−", "Zoom out", () => this.zoom(2)),
      button("◀", "Earlier", () => this.move(-0.25)),
      button("▶", "Later", () => this.move(0.25)),
      button("All", "Show the whole run", () => this.setRange(0, this.end)),
      button("Evaluation", "Show the evaluation window", () => this.setRange(...this.evaluation)));
    this.showRange();
    darkGround.addEventListener("change", () => this.plots.forEach((plot) => plot.rebuild()));
  }

  setRange(from, to) {
    if (!(to > from)) return this.showRange();
    const least = this.end * 1e-6;
    this.from = Math.max(0, Math.min(from, this.end - least));
    this.to = Math.min(this.end, Math.max(to, this.from + least));
    this.showRange();
    this.plots.forEach((plot) => plot.redraw());
    this.listeners.forEach((listener) => listener());
  }

  showRange() {
    this.fromField.value = Number(this.from.toPrecision(7));
    this.toField.value = Number(this.to.toPrecision(7));
  }

  zoom(factor) {
    const [middle, half] = [(this.from + this.to) / 2, ((this.to - this.from) / 2) * factor];
    this.setRange(middle - half, middle + half);
  }

  move(share) {
    const length = this.to - this.from;
    const from = Math.max(0, Math.min(this.from + share * length, this.end - length));
    this.setRange(from, from + length);
  }

  onKey(event) {
    const acts = {
      ArrowLeft: () => this.move(-0.25),
      ArrowRight: () => this.move(0.25),
      "+": () => this.zoom(0.5),
      "=": () => this.zoom(0.5),
      "-": () => this.zoom(2),
      0: () => this.setRange(0, this.end),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }

  // build() returns { data, series, scale, height, draw }; a series has label, colour and style.
  add(title, unit, build) {
    const plot = new TimePlot(this, title, unit, build);
    this.plots.push(plot);
    return plot;
  }
}

TimePlots.count = 0;

class TimePlot {
  constructor(group, title, unit, build) {
    this.group = group;
    this.title = title;
    this.unit = unit;
    this.build = build;
    this.frame = element("div", {
      class: "frame", tabindex: 0, role: "group", onkeydown: (event) => group.onKey(event),
      ondblclick: () => group.setRange(0, group.end),
      "aria-label": `${title}. Arrow keys move, plus and minus zoom, 0 shows the whole run.`,
    });
    this.legend = element("ul", { class: "legend" });
    this.tools = element("div", { class: "tools" });
    this.root = element("section", { class: "plot", "aria-label": title },
      element("h3", {}, title), this.tools, this.frame, this.legend);
    new ResizeObserver(() => this.resize()).observe(this.frame);
  }

  resize() {
    const width = Math.floor(this.frame.clientWidth);
    if (width < 50) return;
    if (!this.plot) this.rebuild();
    else if (this.plot.width !== width) this.plot.setSize({ width, height: this.plot.height });
  }

  redraw() {
    if (this.plot) this.plot.setScale("x", { min: this.group.from, max: this.group.to });
  }

  rebuild() {
    if (this.plot) this.plot.destroy();
    const { group } = this;
    const built = this.build();
    const [text, grid] = [themeColour("faint"), themeColour("grid")];
    const axis = { stroke: text, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 } };
    const series = built.series.map((line) => ({
      label: line.label, stroke: line.colour, width: line.width || 1.25, dash: line.dash, fill: line.fill,
      points: { show: false }, spanGaps: false,
    }));
    const options = {
      width: Math.max(50, Math.floor(this.frame.clientWidth)),
      height: built.height || 260,
      legend: { show: false },
      cursor: { sync: { key: group.name }, drag: { x: true, y: false, setScale: false }, points: { show: built.points !== false } },
      scales: { x: { time: false, range: () => [group.from, group.to] }, y: built.scale || {} },
      bands: built.bands,
      axes: [
        { ...axis, label: built.xLabel || "t [s]", labelSize: 20, size: 40 },
        { ...axis, label: this.unit, labelSize: 20, size: 62, ...(built.axis || {}) },
      ],
      series: [{}, ...series],
      hooks: {
        setSelect: [(plot) => this.selected(plot)],
        setCursor: [(plot) => this.showValues(plot, built)],
        drawClear: [(plot) => this.drawMarkers(plot)],
        draw: built.draw ? [built.draw] : [],
      },
    };
    this.plot = new uPlot(options, built.data, this.frame);
    // The frame has a description; the canvas itself says nothing more.
    this.frame.querySelector("canvas").setAttribute("aria-hidden", "true");
    this.legend.replaceChildren(...built.series.filter((line) => line.label).map((line) => {
      const mark = element("span", { class: line.dash ? "mark dashed" : "mark" });
      mark.style.borderColor = line.colour;
      line.value = element("span", { class: "value" });
      return element("li", {}, mark, line.label, " ", line.value);
    }));
  }

  selected(plot) {
    const { left, width } = plot.select;
    if (width < 3) return;
    const [from, to] = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.group.setRange(from, to);
  }

  showValues(plot, built) {
    const index = plot.cursor.idx;
    built.series.forEach((line, place) => {
      if (!line.value) return;
      const value = index == null ? null : plot.data[place + 1][index];
      line.value.textContent = value == null ? "" : number(value, 3);
    });
  }

  drawMarkers(plot) {
    const { ctx } = plot;
    const { left, top, width, height } = plot.bbox;
    ctx.save();
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    const [from, to] = this.group.evaluation.map((time) => plot.valToPos(time, "x", true));
    ctx.fillStyle = themeColour("raised");
    const [start, end] = [Math.max(left, from), Math.min(left + width, to)];
    if (end > start) ctx.fillRect(start, top, end - start, height);
    for (const { time, label } of this.group.markers) {
      const x = plot.valToPos(time, "x", true);
      if (x < left || x > left + width) continue;
      ctx.strokeStyle = themeColour("faint");
      ctx.fillStyle = themeColour("faint");
      ctx.beginPath();
      ctx.moveTo(x, top);
      ctx.lineTo(x, top + height);
      ctx.stroke();
      ctx.textAlign = x > left + 0.85 * width ? "right" : "left";
      ctx.fillText(label, x + (ctx.textAlign === "left" ? 4 : -4) * devicePixelRatio, top + 12 * devicePixelRatio);
    }
    ctx.restore();
  }
}
