// Elements and numbers as text. Texts of a run are never parsed as HTML.

export function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

// Return a button with its action and data.
export function button(title, onclick, data = {}) {
  const made = Object.assign(element('button', '', title), { onclick });
  Object.assign(made.dataset, data);
  return made;
}

// Return a number with three significant digits; padded: keep trailing zeros.
export function number(value, padded = false) {
  if (value === null || value === undefined || Number.isNaN(value)) return '-';
  if (Number.isInteger(value)) return String(value);
  const size = Math.abs(value);
  if (size < 1e-5 || size >= 1e5) return value.toExponential(2);
  const digits = value.toPrecision(3);
  return padded && !digits.includes('e') ? digits : String(Number(digits));
}

// Return a count with its noun, which has an s unless it is 1.
export function counted(count, noun) {
  return `${count} ${noun}${count === 1 ? '' : 's'}`;
}

// Run an action on a click or Enter.
export function pressable(part, action) {
  part.tabIndex = 0;
  part.onclick = action;
  // A handler that returns false would keep the focus.
  part.addEventListener('keydown', (event) => {
    if (event.key === 'Enter') action();
  });
}
