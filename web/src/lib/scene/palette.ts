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
  person: Color;
  shade: Color;
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
    body: new Color(dark ? '#5A6B7F' : '#5B6B7C'),
    light: new Color(dark ? '#C9D3DE' : '#8796A6'),
    furniture: new Color(dark ? '#4A5561' : '#A9B4C0'),
    // The amber of words is too dark for a figure in light: this one still stands out from the floor, 3.7:1.
    person: dark ? color('--warn') : new Color('#A86F10'),
    shade: new Color(dark ? '#000000' : '#4A5561'),
    accent: color('--accent'),
    danger: color('--danger'),
    warn: color('--warn'),
    text: color('--t2'),
  };
}
