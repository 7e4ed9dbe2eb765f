// Helpers for the document.

/** Return the element of this id; throws if index.html has none. */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`no element #${id}`);
  return found;
}

/** Set the text of an element; does not touch the document if it is the same. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set an attribute; does not touch the document if it is the same; null removes it. */
export function setAttribute(element, name, value) {
  if (element.getAttribute(name) === value) return;
  if (value === null) element.removeAttribute(name);
  else element.setAttribute(name, value);
}

/** Make an element. `properties` are assigned, `children` are elements or text. */
export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/** Show `rows`, arrays of strings, in a list; `row` makes the elements of one. Unchanged rows are not redrawn. */
export function setRows(list, rows, row) {
  const key = JSON.stringify(rows);
  if (list.dataset.shown === key) return;
  list.dataset.shown = key;
  list.replaceChildren(...rows.flatMap((cells) => row(...cells)));
}
