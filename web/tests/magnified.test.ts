import { describe, expect, it } from 'vitest';
import { Across, common, roomOn } from '../src/lib/live/magnified';

const SHOWS = { offsetLeft: 100, offsetTop: 200, width: 156, height: 337, scale: 2.5 };

describe('a page that fingers magnify', () => {
  it('has the room that the bar with the stop leaves, below or beside it', () => {
    const screen = { left: 100, top: 200, right: 256, bottom: 537 };
    expect(roomOn(SHOWS, null)).toEqual(screen);
    expect(roomOn(SHOWS, { left: 100, top: 460, right: 256, bottom: 537 })).toEqual({ ...screen, bottom: 460 });
    expect(roomOn(SHOWS, { left: 200, top: 200, right: 256, bottom: 537 })).toEqual({ ...screen, right: 200 });
  });

  it('shows of a line what both have in common, and nothing of one that is elsewhere', () => {
    const screen = roomOn(SHOWS, null);
    expect(common({ left: 0, top: 190, right: 390, bottom: 240 }, screen)).toEqual({ left: 100, top: 200, right: 256, bottom: 240 });
    expect(common({ left: 0, top: 600, right: 390, bottom: 640 }, screen)).toEqual({ left: 100, top: 600, right: 256, bottom: 600 });
  });

  it('is read from side to side, in whichever order', () => {
    const across = new Across(390);
    across.read(200, 300);
    expect(across.endPx).toBe(0);
    across.read(0, 150);
    expect(across.endPx).toBe(150);
    across.read(150.5, 199.5);
    expect(across.endPx).toBe(300);
    across.read(390, 380);
    expect(across.endPx).toBe(300);
  });

  it('is read anew where it is laid out anew, as when the phone is turned', () => {
    const across = new Across(390);
    across.read(0, 390);
    expect(Across.of(across, 390).endPx).toBe(390);
    expect(Across.of(across, 844).endPx).toBe(0);
    expect(Across.of(undefined, 844).endPx).toBe(0);
  });
});
