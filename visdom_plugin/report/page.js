for (const figure of document.querySelectorAll("figure.card")) {
  const compare = figure.querySelector(".compare"), slider = figure.querySelector("input:not(.turn)");
  if (compare && slider) {
    const set = () => compare.style.setProperty("--cut", `${100 - slider.value}%`);
    slider.addEventListener("input", set);
    const drag = (event) => {
      if (event.buttons !== 1) return;
      const box = compare.getBoundingClientRect();
      slider.value = 100 - (100 * (event.clientX - box.left)) / box.width;
      set();
    };
    compare.addEventListener("pointerdown", drag);
    compare.addEventListener("pointermove", drag);
    compare.style.touchAction = "pan-y";
    compare.addEventListener("dragstart", (event) => event.preventDefault());
    set();
  }
}
const turns = [...document.querySelectorAll("input.turn")];
const show = (value) => {
  for (const turn of turns) {
    turn.value = value;
    turn.closest("figure").querySelector(".orbit").style.setProperty("--at", value);
  }
};
for (const turn of turns) turn.addEventListener("input", () => show(turn.value));
const play = document.getElementById("play");
let timer = 0;
play.addEventListener("click", () => {
  const on = play.getAttribute("aria-pressed") !== "true";
  play.setAttribute("aria-pressed", on);
  play.textContent = on ? "Stop" : "Turn";
  clearInterval(timer);
  if (on) timer = setInterval(() => show((Number(turns[0].value) + 1) % (Number(turns[0].max) + 1)), 120);
});
