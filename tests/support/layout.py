"""JavaScript that finds faults in the layout of a page."""

# Elements with more than their box holds, and texts that lie on one another; the log scrolls.
OVERFLOW = """(() => {
  const seen = (e) => e.checkVisibility() && !e.closest('svg, dialog, pre, .unseen');
  const name = (e) => `${e.tagName}.${e.id || e.className}`;
  const wrong = [...document.querySelectorAll('body *')].filter(seen)
    .filter((e) => e.getBoundingClientRect().right > innerWidth + 1
      || getComputedStyle(e).display != 'inline' && e.scrollWidth > e.clientWidth + 1
      || e.tagName == 'SECTION' && e.scrollHeight > e.clientHeight + 1).map(name);
  const texts = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    if (!walk.currentNode.data.trim() || !seen(walk.currentNode.parentElement)) continue;
    const range = document.createRange();
    range.selectNodeContents(walk.currentNode);
    for (const box of range.getClientRects()) texts.push([walk.currentNode, box]);
  }
  texts.forEach(([one, a], k) => texts.slice(k + 1).forEach(([other, b]) => {
    const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    // Boxes of lines are higher than their letters.
    if (one != other && wide > 1 && high > 0.3 * Math.min(a.height, b.height))
      wrong.push(`${one.data} on ${other.data}`);
  }));
  return wrong;
})()"""
