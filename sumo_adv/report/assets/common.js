const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

/** Text of a file as it may be shown: what is invisible or turns the direction of writing is spelt out. */
function plain(text) {
  return String(text).replace(/[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g,
    (c) => `\u27e8${c.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}\u27e9`);
}

/** An element; strings among the children become text, never markup. */
function el(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined) made.append(typeof child === "object" ? child : plain(child));
  }
  return made;
}

/** A text of a file among ours, kept apart for writing systems of another direction. */
const quoted = (text) => el("bdi", null, text);

const number = (value, digits, unit) =>
  value === null || value === undefined ? "never" : `${value.toFixed(digits)}${unit ? `\u202f${unit}` : ""}`;

/** Digits with a true minus, and no minus before nothing. */
function signed(value, digits) {
  const text = value.toFixed(digits);
  return /^-[0.]+$/.test(text) ? text.slice(1) : text.replace("-", "\u2212");
}

const answer = (value) => (value === null || value === undefined ? "–" : value === true ? "yes" : value === false ? "no" : String(value).replaceAll("_", " "));

/** Colours of the present scheme, by the names of the style's properties. */
function palette() {
  const style = getComputedStyle(document.documentElement), found = {};
  for (const name of ["ground", "paper", "ink", "soft", "line", "accent", "ego", "adversary", "other", "asphalt",
    "marking", "footway", "first", "raw", "stop", "wait", "go", "ego-text", "adversary-text",
    "support", "support-text"]) found[name] = style.getPropertyValue(`--${name}`).trim();
  return found;
}

/** Make a canvas as sharp as the screen; gives back its size in CSS pixels and the ratio. */
function sharpen(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2), box = canvas.getBoundingClientRect();
  const width = Math.max(1, Math.round(box.width)), height = Math.max(1, Math.round(box.height));
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  return { width, height, ratio };
}
