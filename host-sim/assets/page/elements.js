// Elements, numbers, tables and colours. Text from the data is only ever set as text.

function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
}

function svgElement(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

// A number with this many significant digits, plain from 1e-4 to below 1e6; all digits before the point.
function number(value, digits = 4) {
  if (value == null || !Number.isFinite(value)) return "–";
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return value.toLocaleString("en");
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-4 || size >= 1e6)) return value.toExponential(digits - 1);
  if (size >= 10 ** (digits - 1)) return Math.round(value).toLocaleString("en");
  return Number(value.toPrecision(digits)).toString();
}

// What a person has set: all its digits.
function exact(value) {
  return String(value);
}

function counted(count, word) {
  return `${number(count)} ${word}${count === 1 ? "" : "s"}`;
}

function percent(value) {
  if (value == null || !Number.isFinite(value)) return "–";
  return `${value > 0 ? "+" : ""}${value.toFixed(1)} %`.replace("-", "−");
}

// columns: name, value of a row, and how it is shown; `isText` aligns to the left.
function table(caption, columns, rows, options = {}) {
  const head = element("tr", {}, ...columns.map((column) =>
    element("th", { scope: "col", class: column.isText ? "text" : null }, column.name)));
  const cell = (column, row) => {
    const value = column.value(row);
    const shown = column.show ? column.show(value, row) : typeof value === "number" ? number(value) : value ?? "–";
    const exact = typeof value === "number" ? { "data-value": value } : {};
    return element("td", { class: column.isText ? "text" : null, ...exact }, shown);
  };
  const body = rows.map((row) => element("tr", {}, ...columns.map((column) => cell(column, row))));
  const made = element("table", {}, element("caption", {}, caption), element("thead", {}, head), element("tbody", {}, ...body));
  const isTall = rows.length > (options.tallFrom || 20);
  return element("div", { class: isTall ? "scroll tall" : "scroll", tabindex: 0, role: "region", "aria-label": caption }, made);
}

function facts(pairs) {
  const made = pairs.filter(([, value]) => value != null && value !== "")
    .flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]);
  return element("dl", { class: "facts" }, ...made);
}

function copyable(text) {
  const status = element("span", { class: "note", role: "status" });
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
      status.textContent = " copied";
    } catch {
      status.textContent = " select the text to copy it";
    }
  };
  return element("span", {}, element("code", {}, text), " ",
    element("button", { type: "button", onclick: copy, "aria-label": "Copy the command" }, "Copy"), status);
}

// One word of a command line, quoted for a POSIX shell where necessary.
function shellWord(word) {
  return /^[A-Za-z0-9_@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`;
}

// Colours for all types of colour vision (Okabe and Ito 2008), for light and dark ground.
const COLOURS = {
  light: ["#0072b2", "#b87a00", "#00805d", "#b5508a", "#d55e00", "#2f8fd0", "#7a5195", "#666666"],
  dark: ["#4aa8e8", "#f0b429", "#2fc79a", "#e08cc0", "#ff8a4c", "#8fd0f8", "#b79bd6", "#b0b0b0"],
};

const darkGround = matchMedia("(prefers-color-scheme: dark)");

function agentColour(index) {
  const colours = darkGround.matches ? COLOURS.dark : COLOURS.light;
  return colours[index % colours.length];
}

function themeColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function sum(values) {
  return values.reduce((total, value) => total + value, 0);
}
