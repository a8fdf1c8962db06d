// The page: what is there is shown, section by section.

const data = JSON.parse(document.getElementById("run").textContent);
const mainPart = document.getElementById("main");
const contents = element("ul", {});

function section(title, ...children) {
  const id = title.toLowerCase().replaceAll(/[^a-z]+/g, "-");
  mainPart.append(element("h2", { id }, title), ...children.filter(Boolean));
  contents.append(element("li", {}, element("a", { href: `#${id}` }, title)));
}

function header(title, subtitle, verdict, pairs) {
  const items = verdict.map(([kind, name, text]) => element("li", { class: kind }, element("b", {}, `${name}: `), text));
  document.getElementById("header").append(
    element("h1", {}, title), element("p", { class: "note" }, subtitle),
    element("ul", { class: "verdict", "aria-label": "Verdict" }, ...items), facts(pairs));
  document.getElementById("contents").append(contents);
}

function range(values, show) {
  const known = values.filter((value) => value != null && Number.isFinite(value));
  if (!known.length) return "–";
  const [low, high] = [Math.min(...known), Math.max(...known)].map(show);
  return low === high ? low : `${low} to ${high}`;
}

function interval([from, to]) {
  return `[${exact(from)}, ${exact(to)}]`;
}

function verdicts(run) {
  const { agents, checks } = run;
  const found = [];
  if (run.error) found.push(["bad", "Not meaningful", run.error.text]);
  const window = `t in ${interval(run.evaluation)} s`;
  const changes = agents.map((agent) => agent.change_percent_no_network).filter((change) => change != null);
  const baseline = run.baselines.no_network;
  const errors = `RMSE ${range(agents.map((agent) => agent.rmse), (value) => number(value, 3))} over ${window}`;
  if (changes.length) {
    const better = changes.filter((change) => change < 0).length;
    const isEvery = better === agents.length && !run.error;
    const against = range(agents.map((agent) => agent.rmse_no_network), (value) => number(value, 3));
    const text = `${errors}; without a network ${against}, a change of ${range(changes, percent)}`;
    found.push(isEvery ? ["good", "Every agent is better than without a network", text]
      : ["open", `${better} of ${counted(agents.length, "agent")} better than without a network`, text]);
  } else if (run.is_known && baseline?.status === "failed") {
    found.push(["open", "Errors", `${errors}; the run without a network failed: ${baseline.reason}`]);
  } else if (run.is_known && baseline?.status === "this_run") {
    found.push(["", "Errors", `${errors}; the agents have no network`]);
  } else if (run.is_known) {
    found.push(["", "Errors", `${errors}; not compared with a run without a network (use --baselines)`]);
  } else {
    const innovation = range(agents.map((agent) => agent.innovation_rms), (value) => number(value, 3));
    found.push(["", "No reference", `the true state is not known, so there are no errors; RMS of the innovations ${innovation}`]);
  }
  const broadcasts = sum(agents.map((agent) => agent.broadcasts));
  const share = broadcasts / (agents.length * run.steps);
  found.push(["", "Traffic", `${number(broadcasts)} broadcasts, ${number(100 * share, 3)} % of the agents' steps`]);
  const theorem = (name, check) => {
    const kind = { kept: "good", broken: "bad" }[check.status] || "open";
    const text = { kept: "kept; its premises hold as far as this run measured them", broken: "broken, though its premises hold as far as this run measured them" }[check.status];
    const premise = /^not /.test(check.premise) ? check.premise : `not applicable: ${check.premise}`;
    found.push([kind, name, text || premise]);
  };
  if (run.observer) {
    const { certified, bound, reasons } = run.observer;
    found.push(certified ? ["good", "Field observer", `certified: |e₁| of all agents together stays below ${number(bound)} after a long time`]
      : ["open", "Field observer", `nothing is certified: ${reasons.join("; ")}`]);
  }
  theorem("Theorem 1", checks.theorem1);
  theorem("Theorem 2", checks.theorem2);
  return found;
}

function agentTable(run) {
  const has = (key) => run.agents.some((agent) => agent[key] != null);
  const column = (key, name, show) => (has(key) ? [{ name, value: (agent) => agent[key], show }] : []);
  const columns = [
    { name: "agent", value: (agent) => agent.agent },
    ...column("rmse", `RMSE, ${run.run_name} [state unit]`),
    ...column("rmse_no_network", "RMSE, no network [state unit]"),
    // The field observer leaves a network out until it is trained, so both are the same.
    ...(run.observer && has("rmse_no_network") ? [] : column("rmse_untrained", "RMSE, untrained [state unit]")),
    ...column("change_percent_no_network", "change relative to no network", percent),
    ...column("max_error", "largest error [state unit]"),
    ...column("innovation_rms", "innovation RMS [output unit]"),
    ...column("explained_variance", "variance explained", (value) => percent(value == null ? value : 100 * value).replace("+", "")),
    ...column("broadcasts", "broadcasts"),
    ...column("mean_interval", "mean interval [s]"),
    ...column("min_interval", "shortest interval [s]"),
    ...column("frames_lost", "copies lost"),
    ...column("airtime_s", "time on air [s]"),
  ];
  return table(`Errors for t in ${interval(run.evaluation)} s; broadcasts over the whole run`,
    columns, run.agents);
}

function methodTable(run) {
  return table("Methods on the same plant, links and sensors", [
    { name: "method", value: (method) => method.method, isText: true },
    ...[["RMSE of the agents", "rmse"], ["innovation RMS of the agents", "innovation_rms"]]
      .filter(([, key]) => run.methods.some((method) => method[key]?.some((value) => value != null)))
      .map(([name, key]) => ({ name, value: (method) => range(method[key] ?? [], (value) => number(value, 3)),
        show: (text, method) => (method.reason ? "failed" : text) })),
    { name: "broadcasts", value: (method) => method.broadcasts },
    { name: "bytes", value: (method) => method.bytes },
    { name: "knows", value: (method) => method.reason || method.knows, isText: true },
  ], run.methods);
}

function overTime(run, shown) {
  const { traces, events } = run;
  const end = run.steps * run.step_s;
  const group = new TimePlots(end, run.evaluation, run.markers);
  const plots = [];
  if (traces?.time.length && run.is_known) plots.push(errorPlot(group, shown, traces));
  if (traces?.time.length && traces.estimates.length) plots.push(statePlot(group, shown, traces, run.states, run.truth_name));
  if (traces?.innovations.length) plots.push(innovationPlot(group, shown, traces));
  if (events) plots.push(eventPlot(group, events, run.agents.length));
  if (!plots.length) return [element("p", {}, "The scenario recorded neither traces nor events.")];
  shown.listeners.push(() => plots.forEach((plot) => plot.plot && plot.rebuild()));
  const notes = [];
  if (traces?.rows_per_point > 1) {
    notes.push(`Each point stands for ${traces.rows_per_point} recorded rows: errors and innovations are the largest of them. All rows are in traces.csv.`);
  }
  if (events) {
    const where = events.gaps.length ? "where a point has several" : `over ${number(events.interval * events.step_s)} s each`;
    notes.push(`Broadcasts are counted ${where}: the darker, the more.`);
  }
  notes.push("The evaluation window is shaded. Drag over a plot with a mouse, or use the fields and buttons, to change the range of all plots.");
  return [group.tools, element("p", { class: "note" }, notes.join(" ")), agentChooser(shown, run.agents),
    ...plots.map((plot) => plot.root), rangeTable(group, run.agents, traces, events)];
}

function curvePlot(curves) {
  const longest = Math.max(...curves.map((curve) => curve.train.length));
  const group = new TimePlots(Math.max(longest - 1, 1), [0, 0], []);
  const parts = [["train", undefined], ["validation", [6, 3]], ["test", [2, 3]]];
  const plot = group.add("Mean squared error by epoch", "MSE [(state unit/s)²]", () => {
    const series = curves.flatMap((curve, index) => parts
      .filter(([part]) => curve[part].some((value) => value != null))
      .map(([part, dash]) => ({
        label: `agent ${curve.agent}${curve.cycle > 1 ? `, cycle ${curve.cycle}` : ""}: ${part === "train" ? "training" : part}`,
        colour: agentColour(index), dash,
        values: Array.from({ length: longest }, (_, epoch) => (curve[part][epoch] > 0 ? curve[part][epoch] : null)),
      })));
    return {
      data: [Array.from({ length: longest }, (_, epoch) => epoch), ...series.map((line) => line.values)],
      series, scale: { distr: 3 }, xLabel: "epoch",
    };
  });
  return plot.root;
}

function trainingSection(run) {
  const explained = (part) => (training) => training.explained_variance?.[part];
  const share = (value) => (value == null ? "–" : `${number(100 * value, 3)} %`);
  const columns = [
    { name: "agent", value: (training) => training.agent },
    { name: "cycle", value: (training) => training.cycle },
    { name: "samples", value: (training) => training.samples },
    { name: "epochs", value: (training) => training.epochs },
    { name: "MSE, training [(state unit/s)²]", value: (training) => training.training_error },
    { name: "MSE, validation [(state unit/s)²]", value: (training) => training.validation_error },
    { name: "variance explained, training", value: explained("training"), show: share },
    { name: "validation", value: explained("validation"), show: share },
    { name: "last 15 %", value: explained("last"), show: share },
    { name: "used", value: (training) => (training.switched_in ? "yes" : "no") },
    { name: "stopped by", value: (training) => training.stopped_by, isText: true },
  ];
  const all = run.curves.length < run.trainings.length ? element("p", { class: "note" },
    `The curves of the first ${run.curves.length} of ${run.trainings.length} training runs; training.csv has all.`) : null;
  return [run.curves.length ? curvePlot(run.curves) : null, all, table("Training runs of the inner layers", columns, run.trainings)];
}

function theorySection({ checks, observer }) {
  const { theorem1, theorem2 } = checks;
  const rows = [
    ["K₁ solves the matrix inequality", checks.solution ? "yes" : "no",
      `λ_min = ${number(checks.eigenvalue_min, 6)} 1/s (± ${number(checks.eigenvalue_uncertainty, 1)}), k₁ = ${number(checks.k1, 6)} 1/s`],
    ["The agents together measure the whole state", checks.state_covered ? "yes" : "no", ""],
    ["The step is short enough", checks.largest_stable_step == null || checks.step < checks.largest_stable_step ? "yes" : "no",
      `${number(checks.step)} s of at most ${number(checks.largest_stable_step)} s`],
    ["ρ bounds the uncertainty", theorem1.chi_bar_max == null ? "not measured" : theorem1.rho >= theorem1.chi_bar_max ? "yes, as measured" : "no",
      theorem1.chi_bar_max == null ? "" : `ρ = ${number(theorem1.rho)}; χ̄_max about ${number(theorem1.chi_bar_max)}, at least ${number(theorem1.chi_bar_max_at_least)}; the disturbance alone reaches ${number(theorem1.disturbance_max)}`],
    ["Trigger", "", checks.trigger_radius == null ? "not the paper's" : `φ₁ = ${number(checks.phi1, 6)} 1/s, φ₂ = ${number(checks.phi2)} 1/s; with z = 0 it fires at |e₂| = ${number(checks.trigger_radius)}`],
    ["Theorem 1", theorem1.status.replaceAll("_", " "), theorem1.premise || ""],
    ["… its bound on |e₁| in the end", "", `${number(theorem1.ultimate_bound ?? checks.ultimate_bound)}; reached ${number(theorem1.error_evaluated)}`],
    ["Theorem 2", theorem2.status.replaceAll("_", " "), theorem2.premise || ""],
  ];
  if (observer) rows.push(["Field observer", observer.certified ? "certified" : "not certified", observer.certified ? `|e₁| below ${number(observer.bound)}` : observer.reasons.join("; ")]);
  const premises = table("Premises of the theorems, and what the run says of their bounds", [
    { name: "premise or bound", value: ([name]) => name, isText: true },
    { name: "holds", value: ([, holds]) => holds, isText: true },
    { name: "numbers", value: ([, , numbers]) => numbers, isText: true },
  ], rows);
  if (!theorem2.agents.length) return [premises];
  const intervals = table("Theorem 2: intervals between broadcasts", [
    { name: "agent", value: (agent) => agent.agent },
    { name: "status", value: (agent) => agent.status.replaceAll("_", " ") },
    { name: "shortest [s]", value: (agent) => agent.interval_min },
    { name: "bound [s]", value: (agent) => agent.interval_bound },
    { name: "rate of the hold error", value: (agent) => agent.hold_error_rate },
  ], theorem2.agents);
  return [premises, intervals];
}

function packageTable(run) {
  return table("Weight packages", [
    { name: "file", value: (item) => item.file || "given with --weights", isText: true },
    { name: "agent", value: (item) => item.agent },
    { name: "epoch", value: (item) => item.epoch },
    { name: "version", value: (item) => item.version },
    { name: "bytes", value: (item) => item.bytes },
    { name: "signature", value: (item) => (item.signed ? "signed; check it with `weights verify`" : "none") },
    { name: "SHA-256", value: (item) => item.sha256, show: (hash) => element("code", {}, hash) },
    { name: "recipe", value: (item) => item.recipe, isText: true },
  ], run.packages);
}

function healthTable(run) {
  const watched = run.agents.filter((agent) => agent.health);
  if (!watched.length) return null;
  const names = Object.keys(watched[0].health).filter((name) => watched.some((agent) => agent.health[name] > 0));
  if (!names.length) return element("p", {}, "All health counters are 0.");
  return table("Health counters that are not 0", [
    { name: "agent", value: (agent) => agent.agent },
    ...names.map((name) => ({ name: name.replaceAll("_", " "), value: (agent) => agent.health[name] })),
  ], watched);
}

function scenarioText(text) {
  return element("details", {}, element("summary", {}, "Text of the scenario"),
    element("pre", { tabindex: 0 }, text));
}

function command(words) {
  return copyable(words.map((word, index) => shellWord(index === 0 ? word.split(/[\\/]/).at(-1) : word)).join(" "));
}

function showRun(run) {
  header(run.scenario, `Run by host-sim ${run.host_sim}: ${counted(run.agents.length, "agent")}, ${number(run.steps * run.step_s, 6)} s in ${counted(run.steps, "step")}`,
    verdicts(run), [
      ["Seed", run.seed_text],
      ["Scenario's hash", element("code", {}, run.scenario_hash)],
      ["Digest of the run", element("code", {}, run.digest)],
      ["Command", run.command.length ? command(run.command) : null],
    ]);
  const shown = new ShownAgents(run.agents);
  section("Agents", agentTable(run), run.link.length ? table("Link statistics", [
    { name: "layer", value: (layer) => layer.layer, isText: true }, { name: "count", value: (layer) => layer.count }], run.link) : null,
  healthTable(run));
  if (run.methods.length) section("Methods", methodTable(run));
  section("Over time", ...overTime(run, shown));
  section("Network of agents", ...graphSection(run, shown));
  if (run.trainings.length) section("Training", ...trainingSection(run));
  section("Theory", ...theorySection(run));
  if (run.packages.length) section("Packages", packageTable(run));
  if (run.warnings.length) {
    section("Warnings", element("ul", {}, ...run.warnings.map((warning) => element("li", {}, element("code", {}, warning.code), ` ${warning.text}`))));
  }
  section("Scenario", scenarioText(run.scenario_text));
}

function showStudy(study) {
  const described = study.study || {};
  const runs = sum(study.cells.map((cell) => cell.runs));
  const diverged = sum(study.cells.map((cell) => cell.diverged));
  const verdict = [["", "Runs", `${counted(runs, "run")} in ${counted(study.cells.length, "cell")}`]];
  const isPart = described.shard && described.shard !== "1/1";
  if (isPart) verdict.push(["open", "Part of a study", `${described.shard}; put the tables of all parts together, and summarise them with sweep --summarise`]);
  verdict.push(diverged ? ["bad", "Diverged", `${number(diverged)} runs have no result; medians are over the others`] : ["good", "Diverged", "none"]);
  if (described.runs && described.runs !== runs) verdict.push(["open", "Incomplete", `the study has ${number(described.runs)} runs`]);
  header(described.scenario ? `${described.scenario}: study` : "Study", described.host_sim ? `By host-sim ${described.host_sim}` : "", verdict, [
    ["Varied", study.keys.join(", ") || "seeds and initial states only"],
    ["Seeds", described.seeds && `${described.seeds}, from ${study.seed_text}`],
    ["Initial states", described.initial_states && `${described.initial_states}`],
    ["Scenario's hash", described.scenario_hash && element("code", {}, described.scenario_hash)],
    ["Digest of the results", element("code", {}, study.digest)],
    ["Command", described.command?.length ? command(described.command) : null],
  ]);
  section("Trade-off", tradeoffPlot(study));
  section("Cells", cellTable(study));
  if (study.scenario_text) section("Scenario", scenarioText(study.scenario_text));
}

try {
  if (data.cells) showStudy(data);
  else showRun(data);
} catch (error) {
  mainPart.append(element("p", { role: "alert" }, `This page cannot show its data (${error.message}). Make it again with \`host-sim report\`.`));
  throw error;
}
