// Plots over time that share one range of time.

const LINES_MAX = 20; // Up to this many agents are all drawn.

class TimePlots {
  constructor(end, evaluation, markers) {
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
    this.fromField.value = number(this.from, 7).replaceAll(",", "");
    this.toField.value = number(this.to, 7).replaceAll(",", "");
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
      cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false }, points: { show: built.points !== false } },
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

// Which agents have lines of their own.
class ShownAgents {
  constructor(agents) {
    this.count = agents.length;
    const order = agents.map((_, index) => index).sort((a, b) => (agents[a].rmse ?? Infinity) - (agents[b].rmse ?? Infinity));
    this.isAll = this.count <= LINES_MAX;
    this.shown = this.isAll ? agents.map((_, index) => index) : [order.at(-1), order[Math.floor(order.length / 2)], order[0]];
    this.listeners = [];
  }

  toggle(index) {
    if (this.isAll || !(index >= 0 && index < this.count)) return;
    this.shown = this.shown.includes(index) ? this.shown.filter((shown) => shown !== index) : [...this.shown, index];
    this.listeners.forEach((listener) => listener());
  }

  // Lines of these agents, and the spread of all if there are more.
  series(columns, isLogarithmic, name) {
    const positive = (value) => (isLogarithmic && !(value > 0) ? null : value);
    const lines = this.shown.map((index, place) => ({
      label: `agent ${index + 1}`,
      colour: agentColour(this.isAll ? index : place + 1),
      dash: this.isAll && index >= 8 ? [6, 3] : undefined,
      values: columns[index].map(positive),
    }));
    if (this.isAll) return { lines, bands: undefined };
    const quantiles = [0.95, 0.05, 0.5].map(() => []);
    for (let point = 0; point < columns[0].length; point += 1) {
      const sorted = columns.map((column) => column[point]).filter((value) => value != null).sort((a, b) => a - b);
      const at = (share) => (sorted.length ? positive(sorted[Math.round(share * (sorted.length - 1))]) : null);
      [0.95, 0.05, 0.5].forEach((share, place) => quantiles[place].push(at(share)));
    }
    const colour = agentColour(0);
    const spread = [
      { label: `95 % of agents are below`, colour: `${colour}90`, values: quantiles[0] },
      { label: `5 % of agents are below`, colour: `${colour}90`, values: quantiles[1] },
      { label: `median ${name}`, colour, width: 2, values: quantiles[2] },
    ];
    return { lines: [...spread, ...lines], bands: [{ series: [1, 2], fill: `${colour}30` }] };
  }
}

function agentChooser(shown, agents) {
  if (shown.isAll) return null;
  const list = element("ul", { class: "legend" });
  const show = () => list.replaceChildren(...shown.shown.map((index) => element("li", {},
    element("button", { type: "button", "aria-label": `Remove agent ${index + 1}`, onclick: () => shown.toggle(index) },
      `agent ${index + 1} (${number(agents[index].rmse, 3)}) ×`))));
  shown.listeners.push(show);
  show();
  const field = element("input", { type: "number", min: 1, max: agents.length, step: 1 });
  const add = () => {
    const index = Number(field.value) - 1;
    if (!shown.shown.includes(index)) shown.toggle(index);
    field.value = "";
  };
  return element("div", {}, element("div", { class: "tools" }, element("label", {}, "Agent", field),
    element("button", { type: "button", onclick: add }, "Draw this agent, too")), list);
}

function errorPlot(group, shown, traces) {
  return scaledPlot(group, shown, traces, "Estimation errors", "|e₁ᵢ| [state unit]", traces.errors, "error");
}

// A plot of norms by agent, on a logarithmic scale or not.
function scaledPlot(group, shown, traces, title, unit, columns, name) {
  let isLogarithmic = true;
  const plot = group.add(title, unit, () => {
    const { lines, bands } = shown.series(columns, isLogarithmic, name);
    return {
      data: [traces.time, ...lines.map((line) => line.values)],
      series: lines,
      bands,
      scale: { distr: isLogarithmic ? 3 : 1 },
    };
  });
  const box = element("input", { type: "checkbox", checked: true });
  box.addEventListener("change", () => {
    isLogarithmic = box.checked;
    plot.rebuild();
  });
  plot.tools.append(element("label", { class: "check" }, box, "logarithmic"));
  return plot;
}

function statePlot(group, traces, states) {
  let component = 0;
  const plot = group.add("State and estimates", "state [state unit]", () => {
    const estimates = traces.estimates.map(({ agent, values }, place) => ({
      label: `agent ${agent}`, colour: agentColour(place), values: values[component],
    }));
    const isKnown = traces.truth[component]?.some((value) => value != null);
    const truth = isKnown ? [{ label: "true state", colour: themeColour("text"), dash: [6, 4], values: traces.truth[component] }] : [];
    const series = [...estimates, ...truth];
    return { data: [traces.time, ...series.map((line) => line.values)], series };
  });
  const choice = element("select", {}, ...states.map((name, index) => element("option", { value: index }, name)));
  choice.addEventListener("change", () => {
    component = Number(choice.value);
    plot.rebuild();
  });
  plot.tools.append(element("label", {}, "component", choice));
  return plot;
}

function innovationPlot(group, shown, traces) {
  return scaledPlot(group, shown, traces, "Innovations", "|e₃ᵢ| [output unit]", traces.innovations, "innovation");
}

// The times of broadcasts of each agent, from the gaps between them. [s]
function broadcastTimes(events) {
  return events.gaps.map((gaps) => {
    let tick = 0;
    return gaps.map((gap) => (tick += gap) * events.step_s);
  });
}

function firstFrom(times, time) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

function eventPlot(group, events, count) {
  const times = broadcastTimes(events);
  const row = count <= 8 ? 28 : count <= 40 ? 14 : 0;
  const draw = (plot) => {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    const half = (Math.abs(plot.valToPos(2, "y", true) - plot.valToPos(1, "y", true)) / 2) * (count > 40 ? 1 : 0.8);
    if (times.length) drawTicks(plot, times, half, group);
    else drawCounts(plot, events, half, group);
    ctx.restore();
  };
  return group.add("Broadcasts", "agent", () => ({
    data: [[0, group.end], [null, null]],
    series: [{ label: "", colour: "transparent" }],
    scale: { range: () => [0.5, count + 0.5], dir: -1 },
    axis: { splits: count <= 40 ? () => Array.from({ length: count }, (_, index) => index + 1) : undefined, grid: { show: false },
      values: (_, splits) => splits.map((value) => (Number.isInteger(value) ? value : "")) },
    height: row ? 80 + row * count : 420,
    points: false,
    draw,
  }));
}

function drawTicks(plot, times, half, group) {
  const { ctx } = plot;
  const width = Math.max(1, Math.round(devicePixelRatio));
  // The number of broadcasts in each column of pixels: the darker, the more.
  const columns = times.map((ofAgent) => {
    const counts = new Map();
    for (let place = firstFrom(ofAgent, group.from); place < ofAgent.length && ofAgent[place] <= group.to; place += 1) {
      const x = Math.round(plot.valToPos(ofAgent[place], "x", true) / width) * width;
      counts.set(x, (counts.get(x) || 0) + 1);
    }
    return counts;
  });
  let most = 0;
  for (const counts of columns) for (const count of counts.values()) most = Math.max(most, count);
  times.forEach((_, index) => {
    const y = plot.valToPos(index + 1, "y", true);
    ctx.fillStyle = agentColour(index);
    for (const [x, count] of columns[index]) {
      ctx.globalAlpha = most > 1 ? 0.15 + (0.85 * count) / most : 1;
      ctx.fillRect(x, y - half, width, Math.max(1, 2 * half));
    }
  });
}

function drawCounts(plot, events, half, group) {
  const { ctx } = plot;
  const length = events.interval * events.step_s;
  const most = Math.max(1, ...events.counts.map((counts) => Math.max(...counts)));
  ctx.fillStyle = agentColour(0);
  events.counts.forEach((counts, index) => {
    const y = plot.valToPos(index + 1, "y", true);
    const [first, last] = [Math.floor(group.from / length), Math.min(counts.length - 1, Math.ceil(group.to / length))];
    for (let place = first; place <= last; place += 1) {
      if (!counts[place]) continue;
      const [from, to] = [place * length, (place + 1) * length].map((time) => plot.valToPos(time, "x", true));
      ctx.globalAlpha = 0.1 + (0.9 * counts[place]) / most;
      ctx.fillRect(from, y - half, Math.max(1, to - from), Math.max(1, 2 * half));
    }
  });
}

// What the plots show, as numbers: for screen readers, and to read exactly.
function rangeTable(group, agents, traces, events) {
  const place = element("div", {});
  const times = events?.gaps.length ? broadcastTimes(events) : null;
  const fill = () => {
    const points = traces ? [firstFrom(traces.time, group.from), firstFrom(traces.time, group.to)] : [0, 0];
    const largest = (column) => {
      const values = (column || []).slice(points[0], points[1] + 1).filter((value) => value != null);
      return values.length ? values.reduce((most, value) => Math.max(most, value)) : null;
    };
    const columns = [{ name: "agent", value: (agent) => agent.agent }];
    if (traces?.errors.length) columns.push({ name: "largest error", value: (agent) => largest(traces.errors[agent.agent - 1]) });
    if (traces?.innovations.length) {
      columns.push({ name: "largest innovation", value: (agent) => largest(traces.innovations[agent.agent - 1]) });
    }
    if (times) {
      const inRange = (agent) => firstFrom(times[agent.agent - 1], group.to) - firstFrom(times[agent.agent - 1], group.from);
      columns.push({ name: "broadcasts", value: inRange });
    }
    place.replaceChildren(table(`For t in [${number(group.from, 6)}, ${number(group.to, 6)}] s`, columns, agents));
  };
  const details = element("details", {}, element("summary", {}, "The shown range in numbers"), place);
  details.addEventListener("toggle", () => details.open && fill());
  group.listeners.push(() => details.open && fill());
  return details;
}
