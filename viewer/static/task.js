// The panel of the exercise: its text, what its signs mean, and the limits.

const $ = (id) => document.getElementById(id);
const SIGNS = { targets: 'cut here, within the band', zones: 'do not cut', lesion: 'lesion: take it out whole' };

export class Task {
  begin(exercise) {
    $('task').hidden = exercise === null;
    if (exercise === null) return;
    $('task-title').textContent = exercise.title;
    $('task-text').textContent = exercise.instruction;
    const shown = Object.keys(SIGNS).filter((kind) => exercise[kind] !== null && exercise[kind].length !== 0);
    $('task-signs').replaceChildren(...shown.map((kind) => {
      const item = document.createElement('li');
      item.dataset.sign = kind;
      item.textContent = SIGNS[kind];
      return item;
    }));
    $('task-limits').textContent = `Limits: ${exercise.time_limit} s, ${exercise.force_limit} N`;
  }
}
