// What a user types for a value. Decimals are never guessed: 1,5 may be one and a half, or a list.

const NUMBER = /^[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?$/;

/** The number that was typed; throws a sentence. */
export function typedNumber(typed) {
  if (typed.includes(",")) throw new Error(`${typed} is no number: decimals stand behind a point, as in 1.5, and nothing groups digits.`);
  if (!NUMBER.test(typed)) throw new Error(`${typed} is no number: type it as 12, -3.5 or 1e-3.`);
  const number = Number(typed);
  if (!Number.isFinite(number)) throw new Error(`${typed} is too large.`);
  return number;
}

/** Whether what was typed is a whole number that a browser does not hold exactly. */
export const isInexact = (typed) => /^[+-]?\d+$/.test(typed) && !Number.isSafeInteger(Number(typed));
