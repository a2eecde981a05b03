"use strict";
// The lists follow the form at once. Without this script, its button does the same.
const form = document.getElementById("form"), results = document.getElementById("results");
let waiting = 0, newest = 0;

async function show() {
  const number = ++newest, query = new URLSearchParams(new FormData(form)).toString();
  results.setAttribute("aria-busy", "true");
  try {
    const answer = await fetch("/results?" + query);
    const text = await answer.text();
    if (number !== newest) return;
    results.innerHTML = text;
    history.replaceState(null, "", "/?" + query);
  } catch {
    if (number === newest) results.textContent = "The explorer does not answer; is it still running?";
  }
  if (number === newest) results.setAttribute("aria-busy", "false");
}

form.addEventListener("input", (event) => {
  const slider = event.target.type === "range";
  if (slider) {
    form.elements.custom.checked = true;
    form.querySelector(`output[for=${event.target.id}]`).textContent = Number(event.target.value).toPrecision(4).replace(/\.?0+$/, "");
  }
  clearTimeout(waiting);
  waiting = setTimeout(show, slider ? 120 : 350);
});
results.addEventListener("click", (event) => {
  const user = event.target.dataset.user;
  if (user === undefined) return;
  event.preventDefault();
  form.elements.user.value = user;
  form.elements.history.value = form.elements.time.value = "";
  show();
});
form.addEventListener("submit", (event) => { event.preventDefault(); show(); });
