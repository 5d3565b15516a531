// Colours for colour-blind readers (Okabe and Ito; candidates: cividis); `page_file.py` puts those
// of `maasi_filter/colours.py` before them: FOUND and others of features, ROBOTS and NAMED.

// Robot colours in the dark theme.
const BRIGHT = ['#6cc0f5', '#ff9a5c', '#c9a6f0', '#d0ad7a', '#5fd3dd', '#f29ac8'];
const BRIGHT_NAMED = { purple: '#cf9be6', red: '#ff8a8a', green: '#7bd67b', blue: '#6cc0f5' };
const CIVIDIS = [
  [0, 34, 78], [18, 53, 112], [59, 73, 108], [87, 93, 109], [112, 113, 115],
  [138, 134, 120], [165, 156, 116], [195, 179, 105], [225, 204, 85], [254, 232, 56],
];

export function robotColour(names, name) {
  const isDark = document.documentElement.dataset.theme === 'dark';
  const [named, others] = isDark ? [BRIGHT_NAMED, BRIGHT] : [NAMED, ROBOTS];
  return named[name] || others[Math.max(names.indexOf(name), 0) % others.length];
}

// Return the colour of a share, 0 to 1.
export function scaleColour(share) {
  const place = Math.min(Math.max(share, 0), 1) * (CIVIDIS.length - 1);
  const low = Math.floor(place);
  const high = Math.min(low + 1, CIVIDIS.length - 1);
  const mixed = CIVIDIS[low].map((value, axis) => Math.round(value + (CIVIDIS[high][axis] - value) * (place - low)));
  return `rgb(${mixed.join(',')})`;
}

// Return the colour of each candidate by its objective; none where it is not allowed.
export function objectiveColours(candidates) {
  const values = candidates.map((item) => item[6]);
  const allowed = values.filter((value) => value !== null);
  const [low, high] = [Math.min(...allowed), Math.max(...allowed)];
  return values.map((value) => value !== null && scaleColour(high > low ? (value - low) / (high - low) : 1));
}

const known = new Map();

// Return a colour of the theme, cached.
export function themed(name) {
  const key = `${document.documentElement.dataset.theme} ${name}`;
  if (!known.has(key)) known.set(key, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return known.get(key);
}
