// The entries of a list to choose from.

/** Replaces them where they differ, and keeps the choice; `texts` says what is shown of each. */
export function fill(select, values, texts = values) {
  const known = [...select.options].map((option) => option.value);
  if (known.length === values.length && known.every((value, i) => value === values[i])) return;
  const chosen = select.value;
  select.replaceChildren(...values.map((value, i) => new Option(texts[i], value)));
  if (values.includes(chosen)) select.value = chosen;
}
