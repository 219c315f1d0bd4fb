for (const box of document.querySelectorAll(".compare")) {
  const input = box.querySelector("input");
  input.addEventListener("input", () => box.style.setProperty("--cut", input.value + "%"));
}
