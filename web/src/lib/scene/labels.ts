import { Vector3, type Camera } from 'three';

/** A name that floats over the scene as an element of its own, so that it stays sharp and readable. */
export interface Label {
  text: string;
  at: Vector3;
  tone: 'plain' | 'accent' | 'warn' | 'danger';
}

/** Keeps one element per label, and puts each where its point is on the screen. */
export class Labels {
  private readonly elements = new Map<string, HTMLElement>();
  private readonly point = new Vector3();

  constructor(private readonly layer: HTMLElement) {}

  draw(labels: ReadonlyMap<string, Label>, camera: Camera, width: number, height: number): void {
    for (const [name, element] of this.elements) {
      if (labels.has(name)) continue;
      element.remove();
      this.elements.delete(name);
    }
    for (const [name, label] of labels) this.put(name, label, camera, width, height);
  }

  clear(): void {
    this.elements.forEach((element) => element.remove());
    this.elements.clear();
  }

  private put(name: string, label: Label, camera: Camera, width: number, height: number): void {
    let element = this.elements.get(name);
    if (element === undefined) {
      element = document.createElement('span');
      this.layer.append(element);
      this.elements.set(name, element);
    }
    if (element.textContent !== label.text) element.textContent = label.text;
    element.dataset['tone'] = label.tone;
    this.point.copy(label.at).project(camera);
    element.hidden = this.point.z > 1;
    const x = ((this.point.x + 1) / 2) * width;
    const y = ((1 - this.point.y) / 2) * height;
    element.style.transform = `translate(-50%, -50%) translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
  }
}
