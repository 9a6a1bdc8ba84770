// Everything that a reader might miss: text that is cut or too faint, controls without a name.
(() => {
  const shown = (one) => one.checkVisibility({ visibilityProperty: true }) && one.getClientRects().length;
  const channels = (colour) => (colour.match(/[\d.]+/g) ?? []).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((c) => c / 255)
    .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const colour = channels(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] > 0.5) return colour;
    }
    return [255, 255, 255];
  };
  const faint = new Set(), cut = new Set(), small = new Set();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const one = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
    if (!text || !shown(one) || one.closest("script, option, title, .unseen, [aria-hidden]")) continue;
    const style = getComputedStyle(one), svg = one.closest("svg");
    const [a, b] = [channels(svg ? style.fill : style.color), behind(one)].map(light);
    if ((Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 4.5) faint.add(text.slice(0, 40));
    const box = one.getBoundingClientRect();
    if (svg) {
      const frame = svg.getBoundingClientRect();
      if (box.left < frame.left - 1 || box.right > frame.right + 1 || box.top < frame.top - 1 || box.bottom > frame.bottom + 1) {
        cut.add(text);
      }
      if (Math.min(box.width, box.height) < 4) small.add(text);
    }
  }
  const nameless = [...document.querySelectorAll("button, select, input, a, [role=img], [role=region], img, video")]
    .filter((one) => shown(one) && !(one.textContent.trim() || one.getAttribute("aria-label") || one.alt
      || one.labels?.[0]?.textContent.trim())).map((one) => one.outerHTML.slice(0, 80));
  const headings = [...document.querySelectorAll("h1, h2, h3")].filter(shown).map((one) => one.textContent);
  return {
    width: document.documentElement.scrollWidth,
    charts: [...document.querySelectorAll(".chart")].filter(shown).length,
    faint: [...faint], cut: [...cut], small: [...small], nameless,
    twice: headings.filter((one, i) => headings.indexOf(one) !== i),
  };
})()
