// The second half of the login: a browser sends the cookie to every port of this host, this secret only we send.

const KEY = "slipguard.session";
const MARK = "#session=";
const session = taken() ?? kept();

/** What a request needs beside the cookie, as headers. */
export function sessionHeaders() {
  return session ? { "x-slipguard-session": session } : {};
}

/** The secret from the address a login leads to; it does not stay there. */
function taken() {
  if (!window.location.hash.startsWith(MARK)) return null;
  const found = window.location.hash.slice(MARK.length);
  window.history.replaceState(null, "", "/");
  try {
    localStorage.setItem(KEY, found); // for this origin alone, its port included
  } catch {
    // a browser that stores nothing has control until the page is loaded anew
  }
  return found;
}

function kept() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}
