// Elements of the document.

/** The element with that id. */
export const $ = (id) => document.getElementById(id);

/** A new element with properties and content. */
export function make(kind, properties = {}, ...content) {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...content);
  return made;
}

/** Disables a button and writes the reason into the element `ID-reason`, which describes it; an empty reason enables it. */
export function disable(id, reason) {
  // Not `disabled`, so that the keyboard still reaches the button and a screen reader reads the reason.
  $(id).ariaDisabled = String(reason !== "");
  $(`${id}-reason`).textContent = reason;
}
