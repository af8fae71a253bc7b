// Formats numbers for people.

/** An integer with thousands separators. */
export function grouped(number) {
  return number === null || number === undefined ? "–" : Math.round(number).toLocaleString("en");
}

/** A number with a few digits. */
export function short(number, digits = 3) {
  return number === null || number === undefined ? "–" : Number(number).toFixed(digits);
}

/** Seconds in the two largest units. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.floor(seconds);
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  if (whole < 86400) return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
  return `${Math.floor(whole / 86400)} d ${Math.floor((whole % 86400) / 3600)} h`;
}

/** Bytes as megabytes. */
export function megabytes(bytes) {
  return bytes === null || bytes === undefined ? "–" : `${Math.ceil(bytes / 1e6)} MB`;
}

/** Process ids. */
export function processes(ids) {
  return ids && ids.length > 0 ? ids.join(" ") : "none";
}
