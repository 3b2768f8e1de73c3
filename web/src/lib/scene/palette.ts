import { Color } from 'three';

/** The scene's colours, read from the design tokens of the theme that is on. */
export interface Palette {
  background: Color;
  floor: Color;
  grid: Color;
  line: Color;
  body: Color;
  light: Color;
  furniture: Color;
  accent: Color;
  danger: Color;
  warn: Color;
  text: Color;
}

export function readPalette(): Palette {
  const style = getComputedStyle(document.documentElement);
  const color = (name: string): Color => new Color(style.getPropertyValue(name).trim());
  const dark = document.documentElement.dataset['theme'] !== 'light';
  return {
    background: color('--view-bg'),
    floor: color('--view-floor'),
    grid: color('--view-grid'),
    line: color('--t3'),
    body: new Color(dark ? '#5A6B7F' : '#46505C'),
    light: new Color(dark ? '#C9D3DE' : '#9FADBC'),
    furniture: new Color(dark ? '#4A5561' : '#A9B4C0'),
    accent: color('--accent'),
    danger: color('--danger'),
    warn: color('--warn'),
    text: color('--t2'),
  };
}
