// Elements of the page. Texts go in as text, so nothing in a run's data can become markup.

export function element(parent, tag, attributes = {}, text = "") {
  const svg = parent.namespaceURI.endsWith("svg") || tag === "svg";
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag)
    : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  return parent.appendChild(made);
}

/** A term with its value and unit; the value's text is `number.data`. */
export function definition(list, name, unit) {
  const group = element(list, "div");
  element(group, "dt", {}, name);
  const value = element(group, "dd"), number = value.appendChild(document.createTextNode(""));
  if (unit) element(value, "span", { class: "unit" }, unit);
  return { value, number };
}

/** Press the button of a group whose value is chosen. */
export function showChoice(group, chosen) {
  for (const button of group.querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.value === String(chosen));
  }
}
