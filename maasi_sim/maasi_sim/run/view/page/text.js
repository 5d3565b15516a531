// Elements and numbers as text. Nothing of a run is ever read as HTML.

export function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

// Return a number with three significant digits; padded, also where the last ones are 0.
export function number(value, padded = false) {
  if (value === null || value === undefined || Number.isNaN(value)) return '-';
  if (Number.isInteger(value)) return String(value);
  const size = Math.abs(value);
  if (size < 1e-3 || size >= 1e5) return value.toExponential(2);
  const digits = value.toPrecision(3);
  return padded && !digits.includes('e') ? digits : String(Number(digits));
}

// Have something done by a click, or by Enter.
export function pressable(part, action) {
  part.tabIndex = 0;
  part.onclick = action;
  // A handler that returns false, as a comparison may, would hold the focus.
  part.addEventListener('keydown', (event) => {
    if (event.key === 'Enter') action();
  });
}
