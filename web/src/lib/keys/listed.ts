/** Every key of the console by where it acts, for the list that `?` opens: what is not pressed now is learned there, too. */
export interface Group {
  where: string;
  keys: readonly (readonly [key: string, says: string])[];
}

export const GROUPS: readonly Group[] = [
  {
    where: 'Everywhere',
    keys: [
      ['?', 'Show or hide this list'],
      ['Escape', 'Close this list'],
      ['1', 'Live'],
      ['2', 'Audit'],
      ['3', 'Policy'],
      ['4', 'Fleet'],
      ['x', 'Next question that waits'],
      ['m', 'Sound on or off'],
      ['n', 'Dark or light'],
    ],
  },
  {
    where: 'At an open question, on Live',
    keys: [
      ['a', 'Approve the question that is open'],
      ['d', 'Deny the question that is open'],
      ['s', 'Say that you have seen the question'],
    ],
  },
  {
    where: 'For the session, on Live',
    keys: [
      ['p', 'Pause the session'],
      ['r', 'Resume the paused session'],
      ['b', 'Roll the session back'],
      ['t', 'Take over: open or close the panel for driving by hand'],
    ],
  },
  { where: 'On Audit', keys: [['/', 'Search the record']] },
  {
    where: 'In a replay, on Audit',
    keys: [
      [' ', 'Play or pause the record'],
      ['ArrowLeft', 'Event before'],
      ['ArrowRight', 'Next event'],
      ['-', 'Play slower'],
      ['+', 'Play faster'],
    ],
  },
];

/** Those of the panel for driving stand with what drives, which is held and no shortcut. */
export const DRIVING: Group = {
  where: 'While you drive, on Live (hold to run)',
  keys: [
    ['h', 'Go to how the controls are handed back'],
    ['Escape', 'Close the panel, while you do not drive'],
  ],
};

/** Those that the picture hears itself. */
export const CAMERA: Group = {
  where: 'On the picture in 3D, once Tab has led there',
  keys: [
    ['↑ ↓ ← →', 'Turn the camera'],
    ['+ −', 'Nearer, farther'],
  ],
};

const SHOWN: Record<string, string> = { ' ': 'Space', ArrowUp: '↑', ArrowDown: '↓', ArrowLeft: '←', ArrowRight: '→', Escape: 'Esc', '-': '−' };

export function shownKey(key: string): string {
  return SHOWN[key] ?? key.toUpperCase();
}
