// Behind the search worker of the site (scripts/site.py puts it there): a question is asked without its small words.
// The search wants all words of a query in one place, and "how do I" stands beside no answer.
"use strict";

{
  const small = new Set(
    ("a an and are at be by can do does for from get how i if in is it make me my of on or should that the to use using we " +
      "what when where which who why with you your").split(" ")
  );
  const search = self.onmessage;
  const plain = (input) => {
    const words = input.split(/[\s?]+/).filter((word) => word && !small.has(word.toLowerCase()));
    return words.length ? words.join(" ") : input;
  };
  self.onmessage = (told) => {
    const { type, data } = told.data;
    const asks = type === 2 && typeof data.input === "string";
    return search(asks ? { data: { type, data: { ...data, input: plain(data.input) } } } : told);
  };
}
