// The key that commands carry: it came behind the # of the entry link, and is kept for this port alone.

const PLACE = 'stagectl-page-key';

function taken() {
  const given = location.hash.slice(1);
  try {
    if (given) localStorage.setItem(PLACE, given);
    return given || (localStorage.getItem(PLACE) ?? '');
  } catch { return given; } // a browser that stores nothing: until the page is left
}

export const key = taken();
history.replaceState(null, '', location.pathname);
