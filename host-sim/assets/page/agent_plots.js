// What is drawn over time: errors, states, innovations and broadcasts.

const LINES_MAX = 20; // Up to this many agents are all drawn.
const DASHES = [undefined, [7, 3], [2, 3]];

// Which agents have lines of their own, and how these look in every plot.
class ShownAgents {
  constructor(agents) {
    this.count = agents.length;
    const error = (index) => agents[index].rmse ?? Infinity;
    const order = agents.map((_, index) => index).sort((a, b) => error(a) - error(b));
    this.isAll = this.count <= LINES_MAX;
    this.shown = this.isAll ? agents.map((_, index) => index) : [order.at(-1), order[Math.floor(order.length / 2)], order[0]];
    this.places = new Map(this.shown.map((index, place) => [index, place]));
    this.listeners = [];
  }

  toggle(index) {
    if (this.isAll || !(index >= 0 && index < this.count)) return;
    if (!this.places.has(index)) this.places.set(index, this.places.size);
    this.shown = this.shown.includes(index) ? this.shown.filter((shown) => shown !== index) : [...this.shown, index];
    this.listeners.forEach((listener) => listener());
  }

  // The first colour is that of the spread, if there is one.
  style(index) {
    const place = (this.places.get(index) ?? index) + (this.isAll ? 0 : 1);
    return { label: `agent ${index + 1}`, colour: agentColour(place), dash: DASHES[Math.floor(place / COLOURS.light.length) % DASHES.length] };
  }

  // Lines of these agents, and the spread of all if there are more. columns: by agent and point.
  series(columns, isLogarithmic) {
    const drawable = (value) => (isLogarithmic && !(value > 0) ? null : value);
    const lines = this.shown.map((index) => ({ ...this.style(index), values: columns[index].map(drawable) }));
    if (this.isAll) return { lines, bands: undefined };
    const shares = [0.95, 0.05, 0.5];
    const quantiles = shares.map(() => []);
    for (let point = 0; point < columns[0].length; point += 1) {
      // A number that is missing because it is too large is one of the largest.
      const sorted = columns.map((column) => column[point] ?? Infinity).sort((a, b) => a - b);
      shares.forEach((share, place) => {
        const value = interpolated(sorted, share);
        quantiles[place].push(Number.isFinite(value) ? drawable(value) : null);
      });
    }
    const colour = agentColour(0);
    const spread = [
      { label: "95th percentile of all agents", colour: `${colour}90`, values: quantiles[0] },
      { label: "5th percentile", colour: `${colour}90`, values: quantiles[1] },
      { label: "median", colour, width: 2, values: quantiles[2] },
    ];
    return { lines: [...spread, ...lines], bands: [{ series: [1, 2], fill: `${colour}30` }] };
  }
}

// A quantile of ascending values, between neighbours as in summary.csv.
function interpolated(sorted, share) {
  const place = share * (sorted.length - 1);
  const [low, high] = [sorted[Math.floor(place)], sorted[Math.ceil(place)]];
  return low === high ? low : low + (place - Math.floor(place)) * (high - low);
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
  return element("div", {}, element("div", { class: "tools" }, element("label", {}, "Agent to draw", field),
    element("button", { type: "button", onclick: add }, "Add agent")), list);
}

function errorPlot(group, shown, traces) {
  return scaledPlot(group, shown, traces, "Estimation errors", "|e₁ᵢ| [state unit]", traces.errors);
}

// A plot of norms by agent, on a logarithmic scale or not.
function scaledPlot(group, shown, traces, title, unit, columns) {
  let isLogarithmic = true;
  const plot = group.add(title, unit, () => {
    const { lines, bands } = shown.series(columns, isLogarithmic);
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

// truthName: what the plant's own state is, or null if it is not known.
function statePlot(group, shown, traces, states, truthName) {
  let component = 0;
  const plot = group.add("State and estimates", "state [state unit]", () => {
    const estimates = traces.estimates.map(({ agent, values }) => ({ ...shown.style(agent - 1), values: values[component] }));
    const truth = truthName ? [{ label: truthName, colour: themeColour("text"), dash: [6, 4], values: traces.truth[component] }] : [];
    const series = [...estimates, ...truth];
    return { data: [traces.time, ...series.map((line) => line.values)], series };
  });
  const choice = element("select", {}, ...states.map((name, index) => element("option", { value: index }, name)));
  choice.addEventListener("change", () => {
    component = Number(choice.value);
    plot.rebuild();
  });
  plot.tools.append(element("label", {}, "component", choice));
  if (traces.estimates.length < shown.count) {
    plot.root.append(element("p", { class: "note" }, "Of many agents, the page has the estimates of those with the largest, the median and the smallest error."));
  }
  return plot;
}

function innovationPlot(group, shown, traces) {
  return scaledPlot(group, shown, traces, "Innovations", "|e₃ᵢ| [output unit]", traces.innovations);
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

// What the plots show, as numbers.
function rangeTable(group, agents, traces, events) {
  const place = element("div", {});
  const times = events?.gaps.length ? broadcastTimes(events) : null;
  const fill = () => {
    const isEnd = group.to >= group.end;
    const before = (times) => (isEnd ? times.length : firstFrom(times, group.to));
    // The first point stands for rows from before the range on.
    const first = traces ? Math.max(0, firstFrom(traces.time, group.from * (1 + 1e-9) + 1e-12) - 1) : 0;
    const largest = (column) => {
      const values = (column || []).slice(first, before(traces.time)).filter((value) => value != null);
      return values.length ? values.reduce((most, value) => Math.max(most, value)) : null;
    };
    const columns = [{ name: "agent", value: (agent) => agent.agent }];
    if (traces?.errors.length) columns.push({ name: "largest error [state unit]", value: (agent) => largest(traces.errors[agent.agent - 1]) });
    if (traces?.innovations.length) {
      columns.push({ name: "largest innovation [output unit]", value: (agent) => largest(traces.innovations[agent.agent - 1]) });
    }
    if (times) {
      const inRange = (agent) => before(times[agent.agent - 1]) - firstFrom(times[agent.agent - 1], group.from);
      columns.push({ name: "broadcasts", value: inRange });
    }
    const range = `For t in [${number(group.from, 6)}, ${number(group.to, 6)}${isEnd ? "]" : ")"} s`;
    const points = traces?.rows_per_point > 1 ? `; the largest over whole points of ${traces.rows_per_point} rows` : "";
    place.replaceChildren(table(range + points, columns, agents));
  };
  const details = element("details", {}, element("summary", {}, "The shown range in numbers"), place);
  details.addEventListener("toggle", () => details.open && fill());
  group.listeners.push(() => details.open && fill());
  return details;
}
