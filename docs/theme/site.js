// Image comparison by slider, and images that enlarge on click. Without JavaScript both images are side by side.

// <div class="compare" markdown> with two Markdown images: the first is left of the handle, the second right of it.
function slider(box) {
  const [left, right] = box.querySelectorAll("img");
  if (!right) return;
  const range = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 100, value: 50 });
  range.setAttribute("aria-label", `${left.alt} | ${right.alt}`);
  range.addEventListener("input", () => box.style.setProperty("--split", `${range.value}%`));
  const labels = [left, right].map((image) => {
    const label = document.createElement("span");
    label.textContent = image.alt;
    return label;
  });
  box.replaceChildren(left, right, ...labels, document.createElement("i"), range);
  box.classList.add("ready");
}

// Images of the text in a dialog: click or Enter opens it, click or Escape closes it.
function enlargeable(image, dialog) {
  image.tabIndex = 0;
  image.setAttribute("role", "button");
  const open = () => {
    const large = new Image();
    Object.assign(large, { src: image.src, alt: image.alt });
    dialog.replaceChildren(large);
    dialog.showModal();
  };
  image.addEventListener("click", open);
  image.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      open();
    }
  });
}

const dialog = document.createElement("dialog");
dialog.className = "enlarged";
dialog.addEventListener("click", () => dialog.close());
document.body.append(dialog);
document.querySelectorAll(".compare").forEach(slider);
document
  .querySelectorAll(".md-content img:not(.compare img):not(.hero img):not(a img)")
  .forEach((image) => enlargeable(image, dialog));

// Short cells, such as "28.8 dB", stay on one line; site.css gives sentences a width in which they can be read.
const [SHORT, LONG] = [16, 60]; // characters
document.querySelectorAll(".md-typeset td").forEach((cell) => {
  if (cell.textContent.length <= SHORT) cell.style.whiteSpace = "nowrap";
  if (cell.textContent.length > LONG) cell.className = "long";
});
