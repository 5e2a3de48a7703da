// Short messages at the edge of the page. They are shown as text, never as HTML.

const SHOWN_MS = 8000;
const MAX_NOTICES = 4;

export class Notices {
  constructor(place) {
    this._place = place;
    this.texts = [];
  }

  /** @param {string} text @param {'note'|'bad'} kind */
  say(text, kind = 'note') {
    this.texts.push(text);
    if (this.texts.length > 20) this.texts.shift();
    const same = [...this._place.children].find((one) => one.textContent === text);
    same?.remove();
    const element = document.createElement('p');
    element.className = kind;
    element.textContent = text;
    this._place.append(element);
    while (this._place.children.length > MAX_NOTICES) this._place.firstChild.remove();
    setTimeout(() => element.remove(), SHOWN_MS);
  }
}
