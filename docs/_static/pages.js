// The page that is read stands in sight in the list of pages, however far down it is.
document.addEventListener("DOMContentLoaded", () => {
  const list = document.querySelector(".sidebar-scroll");
  const page = list?.querySelector("li.current-page > a.reference");
  if (page) {
    const below = page.getBoundingClientRect().top - list.getBoundingClientRect().top;
    list.scrollTo({ top: below - list.clientHeight / 2, behavior: "instant" });
  }
});
