// Pages about results in a real browser: `cargo xtask page` runs these tests.
//
// Environment: HOST_SIM (the program), FOLDER (for results and screenshots; holds node_modules with
// playwright-core and axe-core), CHROMIUM (the browser's command).
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { readFileSync, rmSync, statSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import { after, before, describe, test } from "node:test";
import { fileURLToPath, pathToFileURL } from "node:url";

const { HOST_SIM, FOLDER, CHROMIUM } = process.env;
const load = createRequire(join(FOLDER, "node_modules", "."));
const { chromium } = load("playwright-core");
const axe = readFileSync(load.resolve("axe-core/axe.min.js"), "utf8");

const DESK = { viewport: { width: 1280, height: 900 } };
const DARK = { ...DESK, colorScheme: "dark" };
const PHONE = { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2, isMobile: true, hasTouch: true };

let browser;
before(async () => {
  const executablePath = execFileSync("sh", ["-c", `command -v ${CHROMIUM}`], { encoding: "utf8" }).trim();
  browser = await chromium.launch({ executablePath, args: ["--no-sandbox", "--disable-gpu"] });
});
after(() => browser?.close());

function hostSim(...words) {
  return execFileSync(HOST_SIM, words, { encoding: "utf8", cwd: FOLDER, maxBuffer: 1 << 28, stdio: ["ignore", "pipe", "ignore"] });
}

// Opens a page; any message, error or request of it fails the test at the end.
async function opened(file, options = DESK) {
  // Only axe needs the exception from the page's own policy; the page is loaded with it.
  const context = await browser.newContext({ ...options, bypassCSP: true });
  const page = await context.newPage();
  const faults = [];
  page.on("console", (message) => faults.push(`console: ${message.text()}`));
  page.on("pageerror", (error) => faults.push(`error: ${error.message}`));
  page.on("request", (request) => request.url().startsWith("file:") || request.url().startsWith("data:") || faults.push(`request: ${request.url()}`));
  await page.goto(pathToFileURL(file).href, { waitUntil: "load" });
  await page.waitForSelector("h2");
  await page.waitForTimeout(300); // The plots are drawn when their width is known.
  const done = async () => {
    await context.close();
    assert.deepEqual(faults, []);
  };
  return { page, done };
}

async function seriousFindings(page) {
  await page.evaluate(axe);
  const { violations } = await page.evaluate(() => window.axe.run());
  const serious = violations.filter((found) => ["serious", "critical"].includes(found.impact));
  return serious.map((found) => `${found.id}: ${found.nodes[0].html}`);
}

// The number of points drawn in a plot, and a hash of all of them.
function picture(page, title) {
  return page.evaluate((name) => {
    const canvas = document.querySelector(`section[aria-label="${name}"] canvas`);
    const copy = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    let [marks, hash] = [0, 0];
    for (let place = 3; place < data.length; place += 4) {
      if (data[place] > 0) marks += 1;
      hash = (hash * 31 + data[place - 3] + data[place]) | 0;
    }
    return { marks, hash };
  }, title);
}

const ranges = (page) => page.evaluate(() => ["from [s]", "to [s]"].map((name) =>
  Number([...document.querySelectorAll("label")].find((label) => label.textContent.startsWith(name)).querySelector("input").value)));

describe("the page about the paper's run", () => {
  const folder = join(FOLDER, "paper");
  const file = join(folder, "report.html");
  let printed;
  before(() => {
    printed = JSON.parse(hostSim("run", "paper", "--report", "--format", "json", "--out", folder));
  });

  test("is small, and the same as a page made from the folder later", () => {
    assert.ok(statSync(file).size <= 2e6, `${statSync(file).size} bytes`);
    const again = join(FOLDER, "again.html");
    hostSim("report", folder, "--out", again);
    assert.equal(readFileSync(again, "utf8"), readFileSync(file, "utf8"));
  });

  test("holds and shows the numbers of the JSON", async () => {
    const { page, done } = await opened(file);
    const held = JSON.parse(await page.locator("#run").textContent());
    for (const [key, value] of Object.entries(printed)) {
      if (key !== "elapsed_s") assert.deepEqual(held[key], value, key);
    }
    const shown = await page.locator("table").first().locator("tbody tr").evaluateAll((rows) =>
      rows.map((row) => [...row.querySelectorAll("td[data-value]")].map((cell) => Number(cell.dataset.value))));
    assert.deepEqual(shown.map((row) => row[1]), printed.agents.map((agent) => agent.rmse));
    assert.deepEqual(shown.map((row) => row[2]), printed.agents.map((agent) => agent.rmse_no_network));
    const text = await page.locator("body").innerText();
    assert.match(text, /Theorem 1: not applicable/);
    assert.match(text, /Every agent is better than without a network/);
    for (const item of held.packages) assert.ok(text.includes(item.sha256));
    await page.screenshot({ path: join(FOLDER, "paper-desk.png"), fullPage: true });
    await done();
  });

  test("zooms all plots together, by mouse, keyboard and fields", async () => {
    const { page, done } = await opened(file);
    const titles = ["Estimation errors", "State and estimates", "Innovations", "Broadcasts"];
    const pictures = () => Promise.all(titles.map((title) => picture(page, title)));
    const whole = await pictures();
    whole.forEach(({ marks }, place) => assert.ok(marks > 1000, titles[place]));
    assert.deepEqual(await ranges(page), [0, 40]);

    const over = page.locator('section[aria-label="Estimation errors"] .u-over');
    await over.scrollIntoViewIfNeeded();
    const box = await over.boundingBox();
    await page.mouse.move(box.x + 0.25 * box.width, box.y + 50);
    await page.mouse.down();
    await page.mouse.move(box.x + 0.5 * box.width, box.y + 60, { steps: 5 });
    await page.mouse.up();
    await page.waitForTimeout(200);
    const [from, to] = await ranges(page);
    assert.ok(Math.abs(from - 10) < 0.2 && Math.abs(to - 20) < 0.2, `${from} ${to}`);
    const zoomed = await pictures();
    titles.forEach((title, place) => assert.notEqual(zoomed[place].hash, whole[place].hash, title));

    await page.locator('section[aria-label="Broadcasts"] .frame').focus();
    await page.keyboard.press("+");
    const [nearer, nearerTo] = await ranges(page);
    assert.ok(nearer > from && nearerTo < to);
    await page.keyboard.press("0");
    assert.deepEqual(await ranges(page), [0, 40]);
    await page.getByLabel("from [s]").first().fill("30");
    await page.keyboard.press("Enter");
    assert.deepEqual(await ranges(page), [30, 40]);

    await page.getByText("The shown range in numbers").click();
    const events = readFileSync(join(folder, "events.csv"), "utf8").trim().split("\n").slice(1).map((line) => line.split(","));
    const inRange = [1, 2, 3].map((agent) => events.filter(([of, , time]) => Number(of) === agent && Number(time) >= 30 && Number(time) <= 40).length);
    const shown = await page.locator("details[open] tbody tr").evaluateAll((rows) => rows.map((row) => Number(row.lastChild.dataset.value)));
    assert.deepEqual(shown, inRange);
    await done();
  });

  for (const [name, options] of Object.entries({ desk: DESK, dark: DARK, phone: PHONE })) {
    test(`has no serious finding of axe and fits: ${name}`, async () => {
      const { page, done } = await opened(file, options);
      assert.deepEqual(await seriousFindings(page), []);
      const [width, inner] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
      assert.ok(width <= inner, `${width} px wide on a screen of ${inner} px`);
      await page.screenshot({ path: join(FOLDER, `paper-${name}.png`), fullPage: true });
      await done();
    });
  }
});

test("a thousand agents fit into one page", async () => {
  const columns = 40;
  const agents = 1000;
  const edges = [];
  for (let index = 1; index <= agents; index += 1) {
    if (index % columns !== 0) edges.push([index, index + 1]);
    if (index + columns <= agents) edges.push([index, index + columns]);
  }
  const base = hostSim("scenario", "expressions").split("[graph]")[0]
    .replace("duration = 40.0", "duration = 1.0").replace(/gain = .*/, "gain = [40.0, 80.0, 80.0]");
  const outputs = ["[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"];
  const lines = Array.from({ length: agents }, (_, index) => `[[agents]]\noutput_matrix = [${outputs[index % 3]}]\n`);
  const scenario = `${base}[graph]\nedges = ${JSON.stringify(edges)}\n[evaluation]\nfrom = 0.5\nto = 1.0\n[record]\ntrace_stride = 2\nevents = true\n${lines.join("")}`;
  writeFileSync(join(FOLDER, "thousand.toml"), scenario);
  hostSim("run", "thousand.toml", "--report", "--out", join(FOLDER, "thousand"));
  const file = join(FOLDER, "thousand/report.html");
  assert.ok(statSync(file).size <= 10e6, `${statSync(file).size} bytes`);
  const { page, done } = await opened(file);
  assert.equal(await page.locator("svg.graph circle").count(), agents);
  assert.ok((await picture(page, "Estimation errors")).marks > 1000);
  assert.ok((await picture(page, "Broadcasts")).marks > 1000);
  await page.getByLabel("Agent to draw").fill("17");
  await page.getByRole("button", { name: "Add agent" }).click();
  assert.match(await page.locator('section[aria-label="Estimation errors"] .legend').innerText(), /agent 17/);
  await page.screenshot({ path: join(FOLDER, "thousand.png"), fullPage: true });
  await done();
});

test("a study shows its trade-off and every cell", async () => {
  const folder = join(FOLDER, "study");
  // A study of an earlier program is not continued.
  rmSync(folder, { recursive: true, force: true });
  hostSim("sweep", "paper", "--set", "learning=[]", "--set", "time.duration=2", "--set", "evaluation={ from = 1.0, to = 2.0 }",
    "--vary", "design.epsilon=1000,3000,9000", "--vary", "design.gain.scale=0.9,1", "--out", folder);
  hostSim("report", folder);
  const { page, done } = await opened(join(folder, "report.html"));
  const held = JSON.parse(await page.locator("#run").textContent());
  assert.equal(held.cells.length, 6);
  assert.equal(await page.locator("tbody tr").count(), 6);
  assert.equal(await page.locator(".legend li").count(), 2);
  const canvas = page.locator("canvas");
  const shot = () => canvas.evaluate((found) => found.toDataURL());
  const whole = await shot();
  const box = await page.locator(".u-over").boundingBox();
  await page.mouse.move(box.x + 0.2 * box.width, box.y + 0.2 * box.height);
  await page.mouse.down();
  await page.mouse.move(box.x + 0.6 * box.width, box.y + 0.7 * box.height, { steps: 5 });
  await page.mouse.up();
  await page.waitForTimeout(200);
  assert.notEqual(await shot(), whole);
  assert.deepEqual(await seriousFindings(page), []);
  await page.screenshot({ path: join(FOLDER, "study.png"), fullPage: true });
  await done();
});

// Scenarios that leave something out, or add something, each of a second.
const SHORT = ["--set", "time.duration=1", "--set", "evaluation={ from = 0.5, to = 1.0 }"];
const KINDS = {
  "one agent": { words: ["single.toml"], text: /the agents have no network|not compared/ },
  "a Kalman filter": { words: ["expressions", ...SHORT, "--set", "method=kalman"], missing: "Innovations" },
  "links that fail": { words: ["deployment", "--without-learning"], text: /Link statistics/ },
  "the field observer": { words: ["paper", "--set", "observer.preset=field", "--set", "learning=[]", "--set", "time.duration=2", "--set", "evaluation={ from = 1.0, to = 2.0 }"], text: /Field observer:/ },
  "a large seed": { words: ["expressions", ...SHORT, "--seed", "9007199254740993"], text: /Seed\s+9007199254740993/ },
  "an unstable run": { words: ["paper", "--set", "learning=[]", "--set", "time.step=0.0024", "--set", "time.duration=0.24", "--set", "evaluation={ from = 0.12, to = 0.24 }"], mayFail: true },
  "no traces": { words: ["expressions", ...SHORT, "--set", "record={ trace_stride = 0, events = false }"], text: /recorded neither traces nor events/ },
  "24 agents": { words: ["many.toml"], text: /95th percentile[\s\S]*those with the largest, the median and the smallest error/ },
};

for (const [name, { words, text, missing, mayFail }] of Object.entries(KINDS)) {
  test(`the page shows ${name} without an error`, async () => {
    const expressions = hostSim("scenario", "expressions").replace("duration = 40.0", "duration = 1.0");
    const window = "\n[evaluation]\nfrom = 0.5\nto = 1.0\n";
    writeFileSync(join(FOLDER, "single.toml"), `${expressions.split("[graph]")[0]}[graph]\nedges = []\n${window}[[agents]]\noutput_matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n`);
    const edges = Array.from({ length: 23 }, (_, index) => [index + 1, index + 2]);
    const agents = edges.concat([0]).map((_, index) => `[[agents]]\noutput_matrix = [[${[0, 1, 2].map((column) => (column === index % 3 ? "1.0" : "0.0")).join(", ")}]]\n`);
    writeFileSync(join(FOLDER, "many.toml"), `${expressions.split("[graph]")[0].replace(/gain = .*/, "gain = [40.0, 80.0, 80.0]")}[graph]\nedges = ${JSON.stringify(edges)}\n${window}${agents.join("")}`);
    const folder = join(FOLDER, name.replaceAll(" ", "-"));
    try {
      hostSim("run", ...words, "--report", "--out", folder);
    } catch (error) {
      assert.ok(mayFail, `${error.message}`);
    }
    const { page, done } = await opened(join(folder, "report.html"));
    const shown = await page.locator("body").innerText();
    if (text) assert.match(shown, text);
    if (missing) assert.ok(!shown.includes(missing));
    if (mayFail) assert.match(shown, /Not meaningful/);
    assert.deepEqual(await seriousFindings(page), []);
    await done();
  });
}

test("pointing at a plot shows values of all plots over time, and of no other", async () => {
  const { page, done } = await opened(join(FOLDER, "paper/report.html"));
  const over = page.locator('section[aria-label="Estimation errors"] .u-over');
  await over.scrollIntoViewIfNeeded();
  const box = await over.boundingBox();
  await page.mouse.move(box.x + 0.6 * box.width, box.y + 50);
  await page.waitForTimeout(100);
  const values = (title) => page.locator(`section[aria-label="${title}"] .value`).allInnerTexts();
  assert.ok((await values("State and estimates")).every((value) => value !== ""));
  assert.ok((await values("Mean squared error by epoch")).every((value) => value === ""));
  await done();
});

test("a recording is shown with its innovations", async () => {
  const folder = join(FOLDER, "recording");
  hostSim("run", fileURLToPath(new URL("../../host-sim/examples/experiment/tanks.toml", import.meta.url)), "--report", "--out", folder);
  const { page, done } = await opened(join(folder, "report.html"));
  assert.ok((await picture(page, "Innovations")).marks > 1000);
  assert.match(await page.locator("table").first().innerText(), /innovation RMS/);
  await page.screenshot({ path: join(FOLDER, "recording.png"), fullPage: true });
  await done();
});

test("text in a scenario cannot become part of the page", async () => {
  const folder = join(FOLDER, "hostile");
  const text = hostSim("scenario", "expressions").replace("duration = 40.0", "duration = 1.0");
  const attack = '</script><script>document.title = "taken"</script><img src=x onerror="document.title = 1">';
  writeFileSync(join(FOLDER, "hostile.toml"), `# ${attack}\n${text}\n[evaluation]\nfrom = 0.5\nto = 1.0\n`);
  hostSim("run", "hostile.toml", "--report", "--out", folder);
  const { page, done } = await opened(join(folder, "report.html"));
  assert.equal(await page.title(), "expressions");
  assert.ok((await page.locator("pre").textContent()).includes(attack));
  assert.equal(await page.locator("img").count(), 0);
  await done();
});
