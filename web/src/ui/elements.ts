/** Elements of the page, made from code. */

type Attributes = Record<string, string | boolean | number>;

/** Makes an element; attributes that are false are left out. Texts are texts: nothing of a file becomes markup. */
export function element<K extends keyof HTMLElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== false) made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children);
  return made;
}

/** A round button with a picture: paths of a 24 x 24 drawing. */
export function iconButton(label: string, kind: string, paths: string): HTMLButtonElement {
  const button = element("button", { class: `round ${kind}`, title: label, "aria-label": label });
  setIcon(button, paths);
  return button;
}

/** Changes the picture of a button; `paths` are the page's own. */
export function setIcon(button: HTMLElement, paths: string): void {
  button.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true">${paths}</svg>`;
}

export const ICONS = {
  play: '<path class="solid" d="M8 5.2v13.6c0 .8.9 1.3 1.5.8l10.2-6.8c.6-.4.6-1.2 0-1.6L9.500 4.400C8.900 3.900 8 4.400 8 5.200z"/>',
  pause: '<path class="solid" d="M7 5h3.600v14H7zM13.400 5H17v14h-3.600z"/>',
  settings: '<path d="M4 7h9M17 7h3M4 12h3M11 12h9M4 17h11M19 17h1"/><circle cx="15" cy="7" r="2"/><circle cx="9" cy="12" r="2"/><circle cx="17" cy="17" r="2"/>',
  stereo: '<path d="M4 7h16a1 1 0 0 1 1 1v8a1 1 0 0 1-1 1h-4.500l-2-3a2 2 0 0 0-3 0l-2 3H4a1 1 0 0 1-1-1V8a1 1 0 0 1 1-1z"/>',
  microphone: '<rect x="9" y="3" width="6" height="11" rx="3"/><path d="M5.500 11.500a6.500 6.500 0 0 0 13 0M12 18v3"/>',
  close: '<path d="M6 6l12 12M18 6L6 18"/>',
};

/** A labelled slider that shows its value; a double click takes it back to `start`. */
export function slider(
  label: string, range: { least: number; most: number; start: number; step: number }, change: (value: number) => void,
): HTMLElement {
  const output = element("output");
  const input = element("input", { type: "range", min: range.least, max: range.most, step: range.step, "aria-label": label });
  const show = (value: number) => {
    input.value = String(value);
    paintShare(input);
    output.textContent = value.toFixed(range.step < 1 ? 2 : 0);
  };
  show(range.start);
  input.addEventListener("input", () => {
    show(Number(input.value));
    change(Number(input.value));
  });
  input.addEventListener("dblclick", () => {
    show(range.start);
    change(range.start);
  });
  return element("label", { class: "row" }, element("span", { title: label }, label), output, input);
}

/** A labelled switch. */
export function toggle(name: string, set: (on: boolean) => void, on = true): HTMLElement {
  const box = element("input", { type: "checkbox", checked: on });
  box.addEventListener("change", () => set(box.checked));
  return element("label", { class: "switch" }, name, box);
}

/** Colours a slider's track up to its thumb. */
export function paintShare(input: HTMLInputElement): void {
  const [least, most] = [Number(input.min), Number(input.max)];
  input.style.setProperty("--share", `${(100 * (Number(input.value) - least)) / (most - least || 1)}%`);
}
