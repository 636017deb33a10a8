// Sets the colours before anything is drawn: those chosen by the button, else those of the system.
(() => {
  const light = matchMedia("(prefers-color-scheme: light)");
  let chosen = null;
  try {
    chosen = localStorage.getItem("theme");
  } catch {
    // Storage may be switched off; the choice then lasts as long as the page.
  }
  function apply() {
    document.documentElement.dataset.theme = chosen ?? (light.matches ? "light" : "dark");
    dispatchEvent(new Event("theme"));
  }
  light.addEventListener("change", apply);
  addEventListener("DOMContentLoaded", () => {
    document.getElementById("theme").addEventListener("click", () => {
      chosen = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
      try {
        localStorage.setItem("theme", chosen);
      } catch {
        // As above.
      }
      apply();
    });
  });
  apply();
})();
