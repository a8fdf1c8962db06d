// The communication graph, with the traffic on its edges.

function graphSection(data, shown) {
  const duration = data.steps * data.step_s;
  const broadcasts = data.agents.map((agent) => agent.broadcasts);
  const edges = data.graph.edges.map(([first, second, weight]) => ({
    first, second, weight, rate: (broadcasts[first - 1] + broadcasts[second - 1]) / duration,
  }));
  const count = data.agents.length;
  const most = Math.max(...edges.map((edge) => edge.rate), 1e-12);
  const [width, height] = [900, count <= 12 ? 320 : 620];
  const margin = 40;
  const at = (index) => [
    margin + data.places[index][0] * (width - 2 * margin), margin + data.places[index][1] * (height - 2 * margin)];
  const lines = edges.map(({ first, second, weight, rate }) => {
    const [[x1, y1], [x2, y2]] = [at(first - 1), at(second - 1)];
    const thickness = (count <= 100 ? 1 : 0.4) + (count <= 100 ? 7 : 2) * (rate / most);
    return svgElement("line", { x1, y1, x2, y2, "stroke-width": thickness.toFixed(2) },
      svgElement("title", {}, `agents ${first} and ${second}: ${number(rate, 3)} frames/s, weight ${number(weight)}`));
  });
  const radius = count <= 12 ? 18 : count <= 100 ? 9 : 4;
  const circles = data.agents.map((agent, index) => {
    const [cx, cy] = at(index);
    const circle = svgElement("circle", { cx, cy, r: radius },
      svgElement("title", {}, `agent ${agent.agent}: ${describe(agent)}`));
    circle.addEventListener("click", () => choose(index));
    return circle;
  });
  const names = count > 40 ? [] : data.agents.map((agent, index) => {
    const [x, y] = at(index);
    const isInside = count <= 12;
    const name = svgElement("text", { x, y: isInside ? y + 5 : y - 13, "pointer-events": "none" }, `${agent.agent}`);
    if (isInside) name.style.fill = "var(--ground)";
    return name;
  });
  const total = sum(edges.map((edge) => edge.rate));
  const label = `Graph of ${counted(count, "agent")} and ${counted(edges.length, "edge")}, ${number(total, 3)} frames per second over all edges`;
  const picture = svgElement("svg", { class: "graph", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label },
    ...lines, ...circles, ...names);

  const chosen = element("p", { role: "status" });
  const choice = element("input", { type: "number", min: 1, max: count, step: 1 });
  choice.addEventListener("change", () => choose(Number(choice.value) - 1));
  function choose(index) {
    if (!data.agents[index]) return;
    choice.value = index + 1;
    circles.forEach((circle, place) => circle.classList.toggle("chosen", place === index));
    const own = edges.filter((edge) => edge.first === index + 1 || edge.second === index + 1);
    const neighbours = own.map((edge) => (edge.first === index + 1 ? edge.second : edge.first));
    chosen.textContent = `Agent ${index + 1}: ${describe(data.agents[index])}; neighbours ${neighbours.join(", ") || "none"}.`;
    if (!shown.shown.includes(index)) shown.toggle(index);
  }
  function describe(agent) {
    const parts = [`RMSE ${number(agent.rmse)}`, `${number(agent.broadcasts)} broadcasts`];
    if (agent.frames_lost != null) parts.push(`${number(agent.frames_delivered)} copies delivered, ${number(agent.frames_lost)} lost`);
    return parts.join(", ");
  }
  const columns = [
    { name: "agents", value: (edge) => `${edge.first} – ${edge.second}` },
    { name: "weight", value: (edge) => edge.weight },
    { name: "frames per second, both ways", value: (edge) => edge.rate },
  ];
  const listed = edges.slice(0, 500);
  const more = edges.length > listed.length ? ` (the first ${listed.length} of ${edges.length})` : "";
  return [
    element("p", {}, `${label}. The width of an edge is the number of frames that its agents send over it; choose an agent to see its numbers.`),
    element("div", { class: "tools" }, element("label", {}, "Agent to show", choice)),
    chosen, picture,
    element("details", {}, element("summary", {}, `The edges as a table${more}`), table("Edges of the graph", columns, listed)),
  ];
}
