// The session key, the second secret of the login. Browsers send the cookie to every port of this host; only this page
// sends the session key.

const KEY = "slipguard.session";
const MARK = "#session=";
const session = readFromAddress() ?? readFromStorage();

/** Return the headers that a request needs in addition to the cookie. */
export function sessionHeaders() {
  return session ? { "x-slipguard-session": session } : {};
}

/** Return the key from the address after a login, and remove it from the address. */
function readFromAddress() {
  if (!window.location.hash.startsWith(MARK)) return null;
  const found = window.location.hash.slice(MARK.length);
  window.history.replaceState(null, "", "/");
  try {
    localStorage.setItem(KEY, found); // only this origin, including its port, can read it
  } catch {
    // a browser without storage has control until the page is reloaded
  }
  return found;
}

function readFromStorage() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}
